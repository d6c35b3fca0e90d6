// @ts-check
/** All texts of the page that do not come from the service. */
import { sceneTitles } from "./tables.js";

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
  const minutes = Math.round(value / 60), hours = Math.floor(minutes / 60);
  return hours ? `${number.format(hours)} h ${minutes % 60} min` : `${minutes} min`;
}
/** @param {string} iso */
export const time = (iso) => moment.format(new Date(iso));
/** @param {number} share */
export const percent = (share) => `${Math.floor(share * 100)}%`;
const ordinals = new Intl.PluralRules("en", { type: "ordinal" });
const suffixes = /** @type {Record<string, string>} */ ({ one: "st", two: "nd", few: "rd", other: "th" });
/** @param {number} n */
const ordinal = (n) => `${number.format(n)}${suffixes[ordinals.select(n)]}`;
/** @param {number} n @param {string} what */
const several = (n, what) => `${number.format(n)} ${what}${n === 1 ? "" : "s"}`;

export const words = {
  page: {
    name: "sgsst", title: (/** @type {string} */ view) => (view ? `${view} · sgsst` : "sgsst"),
    skip: "Skip to content", new: "New", jobs: "Jobs", signOut: "Sign out", main: "Main", api: "API",
    missing: "Page not found", toNew: "New job", retry: "Try again", loading: "Loading…", error: "Something went wrong",
  },
  api: {
    unreachable: "Can't reach the service.",
    status: (/** @type {number} */ status) => `The service returned status ${status}.`,
  },
  scene: {
    notScene: `Not a scene file. Use ${sceneTitles}.`,
    notShown: (/** @type {string} */ title) => `${title} can't be previewed. You can still upload it; the result will be shown.`,
    notPly: "Not a PLY file.",
    notGaussians: "This PLY contains no 3D Gaussians that can be previewed.",
    noSplats: "This GLB contains no 3D Gaussians.",
    newSog: "This SOG version can't be previewed. You can still upload it; the result will be shown.",
    newSpz: "This SPZ version can't be previewed. You can still upload it; the result will be shown.",
    cut: "The file is incomplete.", shorter: (/** @type {number} */ n, /** @type {number} */ declared, /** @type {number} */ found) => `The file is incomplete: ${several(n, "Gaussian")} take ${count(declared)} bytes, but it has ${count(found)}.`,
    unreadable: "Couldn't read the scene.",
    notThere: "Couldn't load the scene.",
    otherColors: "These colors belong to a different scene.",
    tooMany: (/** @type {number} */ n) => `${count(n)} Gaussians exceed what this device can show.`,
    header: (/** @type {{count: number, degree: number, size: number}} */ found) => `${several(found.count, "Gaussian")} · SH degree ${found.degree} · ${size(found.size)}`,
    loading: (/** @type {number} */ done, /** @type {number} */ all) => `${count(done)} of ${count(all)} Gaussians`,
    dropped: (/** @type {number} */ kept, /** @type {number} */ had) => `Shown with SH degree ${kept} of ${had} to fit this device's memory.`,
  },
  viewer: {
    noWebGL: "The 3D view needs WebGL 2, which this browser doesn't support. Everything else works.",
    noPicture: "Couldn't save the image.",
    lost: "The graphics card was reset. The view will return shortly.",
    name: "3D view", view: "view", instructions: "Arrow keys orbit, W A S D Q E move, with Shift faster and with Ctrl slower, + and - zoom, F turns to what is in the middle or under the pointer, comma and period switch cameras, 1 to 9 go to the named views, Space swaps before and after, holding O shows the original, Home shows everything.",
    wipe: "Wipe", wipeAt: (/** @type {string} */ left, /** @type {string} */ right, /** @type {number} */ share) => `${percent(share)} ${left}, the rest ${right}`,
    original: "Original", stylized: "Stylized", painted: "Painted", now: "So far", left: "Left", right: "Right",
    toggle: "Swap before and after", orbit: "Orbit", fly: "Fly", movement: "Movement", home: "Show everything", screenshot: "Save image", full: "Full screen", keys: "Keyboard and gestures",
    camera: "Camera", frames: "Show cameras", free: "Free view", cameraOf: (/** @type {number} */ n, /** @type {number} */ all, /** @type {string} */ name) => `${n} of ${all}${name ? ` · ${name}` : ""}`,
    vr: "VR", ar: "AR", headset: "Show in the headset. Sticks move, turn and blend; the trigger teleports; grip with one hand to move the scene, with both to turn and scale it; hold A or X for the original.",
    notLoadedYet: "Wait until the scene has loaded.",
    previous: "Previous camera", next: "Next camera",
    orbitHelp: [["Drag, or arrow keys", "orbit"], ["Wheel, pinch, or + −", "zoom"]],
    flyHelp: [["Drag, or arrow keys", "look around"], ["Wheel, pinch, or + −", "forward, back"]],
    help: [
      ["Right or middle drag, or two fingers", "pan"], ["W A S D", "move"], ["Q E", "down, up"], ["Shift, Ctrl while moving", "faster, slower"], ["Double click, or F", "turn to what is there"], ["Home", "show everything"],
      [", .", "previous and next camera"], ["1 to 9", "named views"], ["Space", "swap before and after"], ["Hold O", "show the original"],
    ],
  },
  blend: {
    title: "Blend", style: "Amount of style", between: (/** @type {string} */ first, /** @type {string} */ second) => `${first} to ${second}`,
    percent: (/** @type {number} */ share) => `${Math.round(100 * share)}%`, amount: (/** @type {number} */ share) => `${Math.round(100 * share)}% style`,
    save: "Save this blend", saveAs: "Save as", saving: "Saving…", saved: "Saved:",
  },
  cameras: {
    notReadHere: "These cameras can't be previewed. The service reads them after upload.",
    found: (/** @type {number} */ n) => `${several(n, "camera")} shown in the scene`,
    ring: (/** @type {number} */ n) => `${several(n, "view")} around the scene. The sketch is approximate; exact positions are set later.`,
    ringAuto: (/** @type {number} */ n) => `As many views as the scene needs, in rings: “Estimate time” counts them. The sketch shows ${n}.`,
  },
  submit: {
    title: "New job", heading: "Paint a scene", lead: "Repaint a 3D Gaussian scene in the style of a painting. Nothing is uploaded until you press a button below.",
    name: "Name", scene: "Scene", sceneHint: sceneTitles, style: "Style", styleHint: "One painting, or several to blend",
    cameras: "Cameras", camerasHint: "cameras.json, transforms.json, or the files of a COLMAP model", photos: "Photos", photosHint: "Optional: the original photos",
    choose: "Choose", change: "Change", remove: (/** @type {string} */ name) => `Remove ${name}`, removeAll: "Remove all", moreFiles: (/** @type {number} */ n) => `and ${number.format(n)} more`,
    unused: (/** @type {string[]} */ names) => `Not used: ${names.slice(0, 5).join(", ")}${names.length > 5 ? ` and ${number.format(names.length - 5)} more` : ""}. Add one scene (${sceneTitles}), images and camera files (JSON, BIN or TXT).`,
    drop: "Drop your scene here", dropTouch: "Tap to choose a scene", dropMore: "You can add cameras and a painting too.", dropNow: "Drop to add files",
    files: "Files", views: "Views", fromFiles: "Use my cameras", around: "Orbit the object", foreign: "Are these the scene's cameras?", anyway: "Start anyway", howMany: "Number of views", preset: "Preset", essentials: "Essentials", lookOptions: "Look", expertOptions: "Expert", expertHint: "Settings of the method. The preset's values suit most scenes.", weights: "Blend",
    nFiles: (/** @type {number} */ n) => several(n, "file"), more: "More options", regions: "Regions", addRegion: "Add a region", optionsAway: "Couldn't load the options; the preset's defaults apply.",
    regionsHint: "Give parts of the scene their own painting, or freeze them.", region: (/** @type {number} */ n) => `Region ${n}`, part: (/** @type {number} */ n) => `Part ${n}`, paintingOf: (/** @type {string[]} */ names) => `for ${names.join(", ")}`, regionName: "Name", regionSelect: "Select", regionStrength: "Strength", freeze: "Freeze", ownStyle: "Same as the job",
    presets: /** @type {Record<string, string>} */ ({ preview: "Quick look, minutes", standard: "Recommended", paper: "Published settings, hours" }),
    cost: "Estimate time", start: "Start", starting: "Starting…", planning: "Analyzing views…", planned: (/** @type {number} */ step, /** @type {number} */ total) => `${count(step)} of ${several(total, "view")} analyzed`,
    needScene: "Choose a scene.", needStyle: "Choose a painting.", needOwnStyle: "Choose a painting for the rest of the scene.", needSelection: "Select a part of the scene in the 3D view, or remove the region.", needName: "Give the region a name.", needCameras: "Choose camera files, or orbit the object.", noCameras: "No cameras were given, so the views orbit the object. If it doesn't stand upright, turn it with the buttons below the 3D view.",
    resumable: (/** @type {string} */ name, /** @type {string} */ size, /** @type {string} */ share) => `“${name}” (${size}) was ${share} uploaded. Choose it again to finish.`,
    resumed: (/** @type {string} */ name, /** @type {string} */ share) => `“${name}” is ${share} uploaded. Only the rest will be sent.`, forget: "Discard",
    blended: "Blend them", apart: "One job each", paintings: "Several paintings", startAll: (/** @type {number} */ n) => `Start ${n} jobs`, eachTakes: (/** @type {number} */ n) => `Each of the ${n} jobs takes about as long.`,
    createdSome: (/** @type {number} */ n, /** @type {number} */ all) => `${n} of ${all} jobs were created; Start creates the rest.`,
    expired: (/** @type {string[]} */ names) => `No longer on the service: ${names.slice(0, 3).join(", ")}${names.length > 3 ? "…" : ""}. Choose it again.`,
    lost: (/** @type {string[]} */ names) => `A reload forgets files of this device. Choose again: ${names.slice(0, 5).join(", ")}${names.length > 5 ? ` and ${number.format(names.length - 5)} more` : ""}`,
    noHeic: (/** @type {string} */ name) => `${name}: this service doesn't read HEIC. Save it as JPEG, or have the operator run: pip install 'sgsst-service[heif]'`,
    stop: "Stop", created: (/** @type {string} */ name) => `Job “${name}” was created.`, on: "on", off: "off", byTime: "fits the time", byDefault: (/** @type {string} */ text) => `${text} (default)`,
  },
  contents: {
    empty: (/** @type {string} */ name) => `${name} is empty (0 bytes). Choose another file.`,
    notImage: (/** @type {string} */ name) => `${name} is not an image.`, brokenImage: (/** @type {string} */ name) => `${name} is incomplete or damaged. Copy or save the image again.`,
    notCameras: (/** @type {string} */ name) => `${name} isn't a camera file. Use cameras.json, transforms.json, or the files of a COLMAP model.`, notJson: (/** @type {string} */ name) => `${name} is incomplete, or not JSON.`,
  },
  select: {
    name: "Selection", of: (/** @type {string} */ name) => (name ? `Select “${name}”` : "Select a region"), byHand: "Select in the 3D view", written: "Select by coordinates or a property", change: "Change the selection", forget: "Remove the selection",
    selected: (/** @type {number} */ n, /** @type {number} */ all) => `${count(n)} of ${several(all, "Gaussian")} selected`, made: (/** @type {number} */ n) => `${several(n, "Gaussian")} selected by hand`,
    notLoaded: "Choose a scene first, and wait until it has loaded.", weight: "Weight",
    tool: "Tool", tools: { move: "Move", brush: "Brush", lasso: "Lasso", box: "Box", sphere: "Sphere", similar: "Similar" }, mode: "Mode", modes: { add: "Add", subtract: "Subtract", intersect: "Intersect" },
    help: [["B L R", "brush, lasso, box"], ["V", "move the camera"], ["[ ]", "smaller and larger brush"], ["Hold Alt", "subtract instead"], ["Ctrl Z, Ctrl Shift Z", "undo, redo"], ["Ctrl I", "invert"]],
    brushTouch: "Paint over the scene. Choose Subtract to take away, and Move to move the camera.",
    toolHelp: { move: "Drag to move the camera.", brush: "Paint over the scene. Hold Alt to do the opposite; drag with the right button to move the camera.", lasso: "Draw around a part of the scene.", box: "Drag the handles or enter numbers, then apply.", sphere: "Drag the handles or enter numbers, then apply.", similar: "Click a color; then change the tolerance." },
    radius: "Brush size", tolerance: "Tolerance", through: "Select through", connected: "Connected only", atMiddle: "Pick at the middle", apply: "Apply",
    moveShape: "Move", resize: (/** @type {string} */ axis, /** @type {number} */ sign) => `Resize ${sign > 0 ? "+" : "−"}${axis}`, center: ["X", "Y", "Z"], sizes: ["Half width", "Half height", "Half depth"], sphereRadius: "Radius",
    undo: "Undo", redo: "Redo", invert: "Invert", clear: "Clear", cancel: "Cancel", done: "Use selection",
  },
  upright: {
    turn: "Turn the scene by 90°", tip: "Tip the scene by 90°, toward you", which: "Which way is up?", unsure: "The scene doesn't show it, and the views orbit the object upright. Choose the image that stands upright.",
    isUp: (/** @type {string} */ up) => `${up.toUpperCase().replace("-", "−")} is up`, neither: "None of these",
  },
  crop: { crop: "Crop the scene", help: "Only what is inside the box is painted; the rest keeps its colors. Drag the handles, or use the arrow keys on them.", use: "Crop to this box", remove: "Remove the crop", inside: "inside" },
  paint: {
    paint: "Paint", title: "Paint on this view", help: "Paint over the view, and the whole scene takes it over, from all sides. Or save the picture, paint on it in any program, and drop it here again.",
    frozen: "The view stands still.", color: "Color", size: "Brush size", undo: "Undo stroke", download: "Download picture", use: "Use a painted picture", apply: "Apply", undoAll: "Undo painting", stylize: "Stylize this scene", fit: (/** @type {number} */ before, /** @type {number} */ after) => `painted pixels: ${one.format(before)} dB before, ${one.format(after)} dB after`,
    notImage: (/** @type {string} */ name) => `${name} is no image that this browser can read. Save it as PNG.`,
    otherSize: (/** @type {string} */ name, /** @type {number[]} */ [width, height], /** @type {number[]} */ expected) => `${name} has ${width}×${height} pixels, but the view has ${expected.join("×")}. Paint on the downloaded picture, and keep its size.`,
  },
  painting: {
    edit: (/** @type {string} */ name) => `Rotate or crop ${name}`, help: "Drag over the painting to keep a part of it.", left: "Rotate left", right: "Rotate right", whole: "Whole painting", use: "Use it", edges: ["Left %", "Top %", "Right %", "Bottom %"],
    unreadable: (/** @type {string} */ name) => `${name} can't be edited in this browser. You can still use it as it is.`, tooLarge: "This image is too large to edit in this browser. Use it as it is, or make it smaller first.",
  },
  refusals: {
    notNumber: "Must be a number.", notWhole: "Must be a whole number.",
    noLess: (/** @type {number} */ n) => `Must be at least ${count(n)}.`, noMore: (/** @type {number} */ n) => `Must be at most ${count(n)}.`,
    above: (/** @type {number} */ n) => `Must be more than ${count(n)}.`, below: (/** @type {number} */ n) => `Must be less than ${count(n)}.`,
    notListed: (/** @type {string[]} */ names, /** @type {boolean} */ numeric) => `Must be ${[...names, ...(numeric ? ["a number"] : [])].join(", ").replace(/, ([^,]*)$/, " or $1")}.`,
    weight: (/** @type {string} */ name) => `The weight of ${name} must be more than 0.`,
  },
  /** Titles, help, units and defaults of options for artists. Others are shown as the service describes them. */
  options: {
    titles: /** @type {Record<string, string>} */ ({
      content_weight: "Content weight", resolution: "Resolution", views: "Views to use", within: "Time",
      style_scale: "Stroke size", style_rotation: "Rotate the painting", preserve_colors: "Keep the scene's colors", background: "Background", style_background: "Behind transparent paintings",
      refine: "Finer strokes", sh_attenuation: "Soften reflections", unseen: "Parts that no view shows",
      up: "Up direction", elevation: "Height of the orbit", radius: "Distance of the orbit",
      near: "Near plane", drop_invalid: "Skip broken Gaussians", spz_axes: "Axes of an SPZ file", render_mode: "Antialiasing", eps2d: "Pixel blur", steps_coarse: "Steps for rough colors", steps_sos: "Steps for detail", learning_rate: "Learning rate",
      feature_scale: "Layer weighting", style_loss: "Style comparison", position_weights: "Ignore empty background", precision: "Precision", training_background: "Background while painting",
      scales: "Scale weights", scale_sampling: "Fine details in one visit of", seed: "Random seed", memory_limit: "Memory limit", coarsest_side: "Smallest view size", warm_start: "Start from the painting's colors",
      clamp_aware_gradient: "Recover clamped colors", bounded: "Keep colors displayable", early_stop: "Stop when nothing changes", target_loss: "Stop at this loss", cached_weights: "Cached blend weights",
      views_per_step: "Views per step", measure: "Quality check", backbone: "Feature network", pad_sh: "PLY for Unity plugins", workers: "Workers", retention_days: "Keep the results for",
    }),
    help: /** @type {Record<string, string>} */ ({
      content_weight: "The strength as a number: lower values give more style, higher ones keep more of the original.",
      resolution: "Longer side of the views in pixels. Larger is finer, and slower.", views: "Uses this many of the cameras, evenly spread. Fewer is faster.",
      within: "As good as it gets in this time, from its start to its last file. Chooses resolution, views and steps unless they are set.", style_scale: "1 is the painting's own; 2 paints strokes twice as large.", style_rotation: "Turns the strokes, counterclockwise.",
      preserve_colors: "match: the painting takes on the scene's colors. luminance: only brightness changes.", background: "black, white, or R,G,B from 0 to 255, such as 40,40,48.",
      style_background: "black, white, or R,G,B from 0 to 255.", refine: "Splits large Gaussians, up to this many times as many in total. 1 is off; auto splits those too large for strokes.",
      orbit: "auto: as many as the scene needs.", up: "auto: estimated from the scene.", elevation: "One ring at this height. Otherwise, as many rings as the scene needs.", radius: "From the scene's center.",
      retention_days: "After this time, or that of the service if it is shorter, they are deleted.", sh_attenuation: "0 keeps highlights that move with the view, 1 removes them.", unseen: "neighbors: painted like what is around them. freeze: left as they are.",
    }),
    units: /** @type {Record<string, string>} */ ({ content_weight: "", resolution: "", views: "", within: "minutes", style_scale: "×", refine: "×", sh_attenuation: "" }),
    /** Units of the service for one of `units`. */
    factors: /** @type {Record<string, number>} */ ({ within: 60 }),
    defaults: /** @type {Record<string, string>} */ ({ content_weight: "strong", orbit: "auto", radius: "automatic", retention_days: "as long as the service does" }),
  },
  uploads: {
    title: "Uploading", waiting: () => "waiting", sending: (/** @type {number} */ share) => percent(share), offline: (/** @type {number} */ share) => `no connection; ${percent(share)} uploaded`,
  },
  plan: {
    title: "Estimate", decided: "How it will run", ran: "How it ran", seconds: "Estimated time", wholeJob: "for the whole job, once it starts", memory: "Memory", gpuMemory: "GPU memory", workers: "Workers", gaussians: "Gaussians", views: "Views",
    items: /** @type {Record<string, string>} */ ({ "second forward": "Second pass of the network", "uncovered pixels": "Empty parts of the views", "unseen Gaussians": "Gaussians that no view shows" }),
    long: "Shall it be faster?", faster: "As good as it gets in 10 minutes",
    unknown: "unknown", dropped: (/** @type {number} */ n) => `${count(n)} left out`, pixels: (/** @type {number} */ n) => `${hundredths.format(n / 1e6)} megapixels`,
    none: "Nothing was left out.",
  },
  job: {
    stages: /** @type {Record<string, string>} */ ({
      reading: "Reading the files", planning: "Analyzing views", refining: "Choosing Gaussians to split", starting: "Starting to paint", coarse: "Rough colors", sos: "Adding detail", measuring: "Checking quality", painting: "Painting the scene", video: "Rendering the video",
    }),
    unnamed: "Unnamed job", rename: "Rename", newName: "New name", save: "Save", next: "Next in queue", queue: (/** @type {number} */ n) => `${ordinal(n)} in queue`, step: (/** @type {number} */ n, /** @type {number} */ all) => `step ${count(n)} of ${count(all)}`, view: (/** @type {number} */ n, /** @type {number} */ all) => `view ${count(n)} of ${count(all)}`, frame: (/** @type {number} */ n, /** @type {number} */ all) => `frame ${count(n)} of ${count(all)}`,
    left: (/** @type {number} */ s) => (s < 1 ? "almost done" : `about ${seconds(s)} left`), progress: "Progress", remove: "Delete", removeSure: "Delete this job and its results?", keep: "Cancel", deleted: "This job was deleted.", gone: "This job doesn't exist, or was deleted.",
    actions: /** @type {Record<string, string>} */ ({ finish: "Stop here and keep it" }), goOn: "Continue", lost: "Connection lost. Reconnecting…", back: "Reconnected.", loss: "Loss", noLoss: "The chart appears once painting starts.", preview: "Latest preview", noPreview: "The first preview will appear shortly.",
    made: (/** @type {string} */ at) => `Created ${at}`, took: (/** @type {number} */ s) => `took ${seconds(s)}`, attempt: (/** @type {number} */ n) => `attempt ${n}`, expires: (/** @type {string} */ at) => `kept until ${at}`, kept: (/** @type {number} */ n) => `to be kept for ${several(n, "day")} after its end`,
    steps: (/** @type {number} */ n, /** @type {number} */ all) => (n < all ? `${count(n)} of ${several(all, "step")}` : several(n, "step")),
    lossLeft: (/** @type {number} */ left) => (left > 1 ? `the loss is ${percent(left - 1)} above that of the original` : `${percent(left)} of the loss is left`),
    early: /** @type {Record<string, string>} */ ({ within: "Its time was used up", "on-request": "This job was stopped early", converged: "The loss no longer fell", "target-loss": "The target loss was reached" }),
    onward: /** @type {Record<string, string>} */ ({ within: "For the other steps, choose “Continue”; for a finer result, “Same with changes” with more time.", "on-request": "For all steps, choose “Continue”." }),
    risen: "The loss has risen: choose “Same with changes” and give it more steps.",
    threeD: "3D", sheet: "Before and after", result: "Result", download: "Download", format: "Format", converting: "Converted on the first download, which takes about 10 seconds for a million Gaussians.", files: "Files", settings: "Settings", inputs: "Inputs", openReport: "Open the report", noFiles: "Nothing yet.", noScene: "This scene can't be shown here.", view3d: "Result",
    sheetOf: (/** @type {string} */ name) => `Views of ${name} before and after`, failed: "The job failed", anotherPainting: "Try another painting", changed: "Same with changes",
  },
  video: {
    title: "Video", path: "Camera path", paths: /** @type {Record<string, string>} */ ({ orbit: "Once around", cameras: "Through the cameras" }), length: "Length", seconds: (/** @type {number} */ n) => `${n} seconds`, size: "Size", pixels: (/** @type {string | number} */ n) => (n ? `${n} pixels` : "Own size"),
    compare: "Start with the original", make: "Make a video", again: "Make another video", starting: "Starting the video…", made: "The video is ready.", progress: "Video progress", player: "Video of the result", download: "Download video",
    rendering: (/** @type {number} */ n, /** @type {number} */ all, /** @type {number | null} */ left) => `Frame ${count(n)} of ${count(all)}${left ? `, about ${seconds(left)} left` : ""}. You can leave this page.`,
    unplayable: "This browser can't play H.264 video. Download it instead.",
  },
  chart: {
    seconds: "seconds of steps", loss: "loss", all: "mean of all views", single: "single views", coarse: "coarse",
    told: (/** @type {number} */ from, /** @type {number} */ to, /** @type {number} */ s) => `Loss over time: from ${three.format(from)} to ${three.format(to)} in ${seconds(s)}`,
  },
  jobs: {
    title: "Jobs", filter: "Filter", status: "Status", any: "Any status", empty: "No jobs yet", emptyLead: "Your jobs will appear here.", noMatch: "No matching jobs.", more: "Show more", choose: "Compare", select: (/** @type {string} */ name) => `Compare ${name}`, compare: "Compare", chooseTwo: "Select two or more finished jobs of the same scene.", remove: (/** @type {string} */ name) => `Delete ${name}`, removed: "Deleted.", otherScenes: "Those use different scenes.",
  },
  compare: { title: "Compare", heading: (/** @type {string} */ a, /** @type {string} */ b) => `${a} and ${b}`, several: (/** @type {number} */ n) => `${n} paintings of one scene`, notThere: "One of these jobs is missing or unfinished.", sheet: "Jobs side by side" },
  gallery: {
    title: "Gallery", bundled: "Public-domain paintings", use: (/** @type {string} */ title) => `Add ${title}`,
    paintings: /** @type {Record<string, string>} */ ({
      starry_night: "The Starry Night, Vincent van Gogh", wheat_field_with_cypresses: "Wheat Field with Cypresses, Vincent van Gogh", great_wave: "The Great Wave off Kanagawa, Hokusai",
      shipwreck: "The Wreck of a Transport Ship, Turner", rembrandt_old_man: "Old Man, Rembrandt", vallotton_woodcut: "Woodcut, Félix Vallotton",
    }),
  },
  example: { start: "Try the example: a motorcycle", preparing: "Preparing the example…", credit: "Starts a job at once, in The Starry Night. Scene: Middlebury 2014, D. Scharstein et al." },
  strengths: { legend: "Style strength", titles: /** @type {Record<string, string>} */ ({ light: "Light", balanced: "Balanced", strong: "Strong" }) },
  share: {
    title: "Share", help: "Anyone with the link can see this result in 3D, before and after, but nothing else.", create: "Create a link", lifetime: "Link expires after", days: (/** @type {number} */ n) => several(n, "day"),
    link: "Link to this result", copy: "Copy", copied: "Copied.", once: "Copy it now; it won't be shown again.", poster: "Show an image where the link is posted", frame: "HTML for your web page", iframe: (/** @type {string} */ url) => `<iframe src="${url}" title="3D scene" width="800" height="450" style="border: 0" loading="lazy" allow="fullscreen; xr-spatial-tracking"></iframe>`, until: (/** @type {string} */ at) => `Works until ${at}`, revoke: "Revoke", revokeOf: (/** @type {string} */ at) => `Revoke the link until ${at}`, revoked: "The link no longer works.",
  },
  viewpoints: {
    title: "Views", path: "Fly through them", start: "Start here", usual: "Start at the usual place", name: "Name of the view", add: "Add view", numbered: (/** @type {number} */ n) => `View ${n}`, remove: (/** @type {string} */ name) => `Remove ${name}`,
    saving: "Saving…", started: "The result, its links and its page open here.", reset: "The result opens at its usual place.", added: (/** @type {string} */ name) => `“${name}” was added.`, removed: "The view was removed.",
  },
  shared: { title: "Shared result", until: (/** @type {string} */ at) => `Shared until ${at}`, gone: "This link doesn't work" },
  signIn: { title: "Sign in", heading: "Sign in", lead: "This service requires an API key.", expired: "Your session has expired, or you signed out in another tab. Sign in to continue where you were.", where: "Enter your API key. Ask your administrator for one.", key: "API key", go: "Sign in", wrong: "That key isn't valid.", out: "You signed out." },
};
