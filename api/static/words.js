// @ts-check
/** Every word of the page that is not the service's own. */

const number = new Intl.NumberFormat("en");
const one = new Intl.NumberFormat("en", { maximumFractionDigits: 1 });
const three = new Intl.NumberFormat("en", { maximumSignificantDigits: 3 });
const hundredths = new Intl.NumberFormat("en", { maximumFractionDigits: 2 });
const moment = new Intl.DateTimeFormat("en", { dateStyle: "medium", timeStyle: "short" });

/** @param {number} value */
export const count = (value) => number.format(value);
/** @param {number} value */
export const rough = (value) => (value >= 1e4 ? number.format(Math.round(value)) : three.format(value));
/** @param {number} bytes */
export function size(bytes) {
  const units = ["B", "kB", "MB", "GB", "TB"], step = Math.min(4, Math.floor(Math.log10(Math.max(bytes, 1)) / 3));
  return `${one.format(bytes / 1000 ** step)} ${units[step]}`;
}
/** @param {number} value */
export function seconds(value) {
  if (value < 1) return "less than a second";
  if (value < 90) return `${Math.round(value)} s`;
  if (value < 5400) return `${Math.round(value / 60)} min`;
  return `${one.format(value / 3600)} h`;
}
/** @param {string} iso */
export const time = (iso) => moment.format(new Date(iso));
/** @param {number} share */
export const percent = (share) => `${Math.floor(share * 100)} %`;
/** @param {number} n @param {string} what */
const several = (n, what) => `${number.format(n)} ${what}${n === 1 ? "" : "s"}`;

export const words = {
  page: {
    name: "sgsst", title: (/** @type {string} */ view) => (view ? `${view} · sgsst` : "sgsst"),
    skip: "Skip to content", new: "New", jobs: "Jobs", signOut: "Sign out", main: "Main", api: "API",
    missing: "There is no such page.", toNew: "Begin a new job", retry: "Try again", loading: "Loading…", error: "Something went wrong",
  },
  api: {
    unreachable: "The service cannot be reached.",
    status: (/** @type {number} */ status) => `The service answered ${status}.`,
  },
  scene: {
    notScene: "This is no scene: no PLY, SPZ or .splat file.",
    notPly: "This is not a PLY file.",
    notBinary: "Only binary little-endian PLY can be shown here. The service may still read it.",
    notGaussians: "This PLY holds no 3D Gaussians that can be shown here.",
    newSpz: "SPZ of this version cannot be shown here. It can be sent as it is, and is shown once it is stylized.",
    cut: "The file ends too early.",
    unreadable: "The scene could not be read.",
    notThere: "The scene could not be fetched.",
    otherColors: "These colors are of another scene.",
    tooMany: (/** @type {number} */ n) => `${count(n)} Gaussians are more than this device can show.`,
    header: (/** @type {{count: number, degree: number, size: number}} */ found) => `${several(found.count, "Gaussian")} · SH degree ${found.degree} · ${size(found.size)}`,
    loading: (/** @type {number} */ done, /** @type {number} */ all) => `${count(done)} of ${count(all)} Gaussians`,
    dropped: (/** @type {number} */ kept, /** @type {number} */ had) => `Shown with SH degree ${kept} of ${had}: all of it does not fit this device's memory.`,
  },
  viewer: {
    noWebGL: "This browser has no WebGL 2, which the 3D view needs. Everything else works.",
    noPicture: "The picture could not be made.",
    lost: "The graphics device went away. The view comes back when it does.",
    name: "3D view", instructions: "Arrow keys turn, W A S D Q E move, plus and minus approach, comma and full stop go through the cameras, Space switches, Home shows everything.",
    wipe: "Wipe", wipeAt: (/** @type {string} */ left, /** @type {string} */ right, /** @type {number} */ share) => `${percent(share)} ${left}, the rest ${right}`,
    original: "Original", stylized: "Stylized", left: "Left", right: "Right",
    toggle: "Switch sides", orbit: "Orbit", fly: "Fly", movement: "Movement", home: "Show everything", screenshot: "Save a picture", full: "Full screen", keys: "Keys and gestures",
    camera: "Camera", free: "Free view", cameraOf: (/** @type {number} */ n, /** @type {number} */ all, /** @type {string} */ name) => `${n} of ${all}${name ? ` · ${name}` : ""}`,
    previous: "Previous camera", next: "Next camera",
    help: [
      ["Drag, or arrow keys", "turn"], ["Right drag, two fingers, or A D Q E", "shift"], ["Wheel, pinch, or + −", "nearer, farther"],
      ["W S", "forward, back"], [", .", "previous and next camera"], ["Space", "switch sides"], ["Home", "show everything"],
    ],
  },
  cameras: {
    notReadHere: "These cameras cannot be drawn here. The service reads them when they are sent.",
    found: (/** @type {number} */ n) => `${several(n, "camera")}, drawn in the scene`,
    ring: (/** @type {number} */ n) => `${several(n, "view")} in a ring, roughly as drawn. The service fits them to the scene.`,
    ringAuto: "As many views as the scene's surface needs, in rings. The drawn ring is a sketch.",
  },
  submit: {
    title: "New job", heading: "Paint a scene", lead: "Give a 3D Gaussian scene the manner of a painting. Nothing is sent until you ask for it.",
    scene: "Scene", sceneHint: "PLY, compressed PLY, SPZ or .splat", style: "Style", styleHint: "A painting; or several, which are mixed",
    cameras: "Cameras", camerasHint: "cameras.json, transforms.json, or the files of a COLMAP model", photos: "Photos", photosHint: "Optional: what the content is compared with",
    choose: "Choose", change: "Change", remove: (/** @type {string} */ name) => `Remove ${name}`, drop: "Drop a scene here", dropMore: "with its cameras and a painting, if you like", dropNow: "Let go to add the files",
    files: "Files", views: "Views", fromFiles: "Camera files", around: "Around the object", howMany: "Number of views", look: "Look", weights: "Share of each painting",
    nFiles: (/** @type {number} */ n) => several(n, "file"), more: "All options", find: "Find an option", regions: "Regions", addRegion: "Add a region", noOptions: "No option has such a name.", optionsAway: "The options could not be loaded; the presets' own are used.",
    regionsHint: "Parts of the scene with a painting of their own, or left as they are.", region: (/** @type {number} */ n) => `Region ${n}`, ownStyle: "The job's own style",
    presets: /** @type {Record<string, string>} */ ({ preview: "Minutes. To see where it goes.", standard: "The usual choice.", paper: "The published schedule. Hours." }),
    cost: "What would it cost?", start: "Start", starting: "Starting…", planning: "Looking at the views…", planned: (/** @type {number} */ step, /** @type {number} */ total) => `${count(step)} of ${several(total, "view")} looked at`,
    needScene: "Choose a scene.", needStyle: "Choose a painting.", needCameras: "Choose camera files, or views around the object.",
    resumable: (/** @type {string} */ name, /** @type {string} */ share) => `“${name}” had arrived to ${share} when the page was left. Choose it again, and the rest is sent.`, forget: "Forget it",
    stop: "Stop", refused: "The service has refused this.", unit: (/** @type {string} */ unit) => unit, unset: (/** @type {string} */ text) => text, on: "on", off: "off", byDefault: (/** @type {string} */ text) => `${text} (default)`,
  },
  uploads: {
    waiting: () => "waiting", paused: (/** @type {number} */ share) => `paused at ${percent(share)}`, offline: (/** @type {number} */ share) => `no connection; ${percent(share)} has arrived`,
    sending: (/** @type {number} */ share) => percent(share), done: (/** @type {number} */ _, /** @type {boolean} */ known) => (known ? "the service has it already" : "sent"),
    pause: "Pause", resume: "Go on", title: "Sending", progress: (/** @type {string} */ name) => `Sending ${name}`,
  },
  plan: {
    title: "What it would cost", decided: "What was decided", seconds: "Time of the steps", memory: "Memory", gpuMemory: "GPU memory", workers: "Workers", gaussians: "Gaussians", views: "Views",
    unknown: "not known", byService: "automatic", dropped: (/** @type {number} */ n) => `${count(n)} left out`, pixels: (/** @type {number} */ n) => `${hundredths.format(n / 1e6)} megapixels`,
    item: "What", decision: "Decision", reason: "Because", none: "Nothing was left out.",
  },
  job: {
    statuses: /** @type {Record<string, string>} */ ({
      queued: "Queued", starting: "Starting", running: "Running", canceling: "Canceling", succeeded: "Done", failed: "Failed", canceled: "Canceled", expired: "Expired",
    }),
    stages: /** @type {Record<string, string>} */ ({
      reading: "Reading the files", planning: "Looking at the views", starting: "Starting the workers", coarse: "Coarse scale", sos: "All scales", measuring: "Measuring views between the cameras",
    }),
    unnamed: "Unnamed job", next: "Next in the queue", queue: (/** @type {number} */ n) => `Number ${count(n)} in the queue`, step: (/** @type {number} */ n, /** @type {number} */ all) => `step ${count(n)} of ${count(all)}`, view: (/** @type {number} */ n, /** @type {number} */ all) => `view ${count(n)} of ${count(all)}`,
    left: (/** @type {number} */ s) => `about ${seconds(s)} left`, progress: "Progress", cancel: "Cancel", retry: "Retry", remove: "Delete", removeSure: "Delete it, with its results?", keep: "Keep it",
    lost: "The connection is lost. Trying again…", back: "Connected again.", loss: "Loss", noLoss: "The curve begins with the first steps.", preview: "Newest preview", noPreview: "The first picture comes with the first step.",
    made: (/** @type {string} */ at) => `Created ${at}`, took: (/** @type {number} */ s) => `took ${seconds(s)}`, attempt: (/** @type {number} */ n) => `attempt ${n}`, expires: (/** @type {string} */ at) => `results stay until ${at}`,
    threeD: "3D", sheet: "Before and after", report: "Report", files: "Downloads", settings: "Settings", inputs: "Inputs", openReport: "Open the report", noFiles: "Nothing yet.", noScene: "The scene cannot be shown here.", view3d: "Result", compare: "Compare with another run", compareWith: "Another run of this scene", noOther: "There is no other finished run of this scene.",
    sheetOf: (/** @type {string} */ name) => `Views of ${name} before and after`, failed: "The job has failed", again: "Stylize this scene again", preparing: "Preparing…",
  },
  chart: {
    seconds: "seconds", loss: "loss", all: "all scales", coarse: "coarse", scale: (/** @type {number} */ n) => (n ? `1/${2 ** n}` : "full size"),
    told: (/** @type {number} */ from, /** @type {number} */ to, /** @type {number} */ s) => `Loss against seconds: from ${three.format(from)} to ${three.format(to)} in ${seconds(s)}`,
  },
  jobs: {
    title: "Jobs", filter: "Filter", name: "Name", status: "Status", any: "Any status", empty: "No jobs yet", emptyLead: "Your jobs will stand here, each with its newest picture.", noMatch: "No job matches.", more: "Show more", choose: "Compare", select: (/** @type {string} */ name) => `Compare ${name}`, compare: "Compare the two", chooseTwo: "Choose two finished runs of one scene to compare them.", remove: (/** @type {string} */ name) => `Delete ${name}`, removed: "Deleted.", otherScenes: "These two are of different scenes.",
  },
  compare: { title: "Compare", heading: (/** @type {string} */ a, /** @type {string} */ b) => `${a} and ${b}`, notThere: "One of these runs is not there, or has no result." },
  signIn: { title: "Sign in", heading: "A key, please", lead: "This service lets in who has an API key. Its operator gives them out (sgsst keys create).", key: "API key", go: "Sign in", wrong: "The service does not know this key.", out: "Signed out." },
};
