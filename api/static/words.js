// @ts-check
/** Every word of the page that is not the service's own. */

const number = new Intl.NumberFormat("en");

export const words = {
  scene: {
    notPly: "This is not a PLY file.",
    notBinary: "Only binary little-endian PLY can be shown here. The service may still read it.",
    notGaussians: "This PLY holds no 3D Gaussians.",
    packed: "A compressed scene is shown once it is stylized. It can be sent as it is.",
    cut: "The file ends too early.",
    unreadable: "The scene could not be read.",
    notThere: "The scene could not be fetched.",
    otherColours: "These colours are of another scene.",
    tooMany: (/** @type {number} */ count) => `${number.format(count)} Gaussians are more than this device can show.`,
  },
  viewer: {
    noWebGL: "This browser has no WebGL 2, which the 3D view needs. Everything else works.",
    noPicture: "The picture could not be made.",
  },
  cameras: {
    notReadHere: "These cameras cannot be drawn here. The service reads them when they are sent.",
  },
};
