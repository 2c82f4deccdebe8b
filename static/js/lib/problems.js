// The engine's sentences as people at the pages read them. The engine speaks to whoever holds project.json and a
// command line: it names places in the file, whole paths and commands. Here each place is the step where it is decided.

/** @typedef {import("./types.js").StepName} StepName */
/** @typedef {{words: string, step: StepName | null}} Told a sentence, and the step where it is put right */

const OF_TARGET = String.raw`^targets(?:\[\d+\]|\.(.+?))`;
/** What each place in project.json is called, and where it is decided; the first that fits. @type {{place: RegExp, name: string, step: StepName}[]} */
const PLACES = [
  { place: /^inputs\.video/, name: "Video", step: "inputs" },
  { place: /^inputs\.cloud/, name: "Point cloud", step: "inputs" },
  { place: /^inputs\.lens/, name: "Lens", step: "inputs" },
  { place: /^inputs\.gps/, name: "GPS", step: "inputs" },
  { place: /^inputs/, name: "Inputs", step: "inputs" },
  { place: /^orthoimage/, name: "Orthoimage", step: "orthoimage" },
  { place: /^reference_frame/, name: "Reference frame", step: "correspondences" },
  { place: /^correspondence\b/, name: "Pair", step: "correspondences" },
  { place: /^correspondences/, name: "Correspondences", step: "correspondences" },
  { place: /^moving_regions_px/, name: "Moving regions", step: "regions" },
  { place: new RegExp(`${OF_TARGET}\\.lines\\.(L1|L2|T1)`), name: "Band $2", step: "regions" },
  { place: new RegExp(`${OF_TARGET}\\.lines`), name: "Bands", step: "regions" },
  { place: new RegExp(`${OF_TARGET}\\.height_m`), name: "Height", step: "regions" },
  { place: new RegExp(`${OF_TARGET}\\.p1_p2_m`), name: "Distance P1–P2", step: "regions" },
  { place: /^targets(?:\[\d+\]|\.\S+)/, name: "Target", step: "regions" },
  { place: /^targets/, name: "Targets", step: "regions" },
  { place: /^excluded_frames/, name: "Excluded frames", step: "review" },
  { place: /^intervals_s\.pre_event/, name: "Pre-event interval", step: "drift" },
  { place: /^intervals_s\.event/, name: "Event interval", step: "drift" },
  { place: /^intervals_s\.residual/, name: "Residual interval", step: "drift" },
  { place: /^drift/, name: "Filter", step: "drift" },
];
/** What belongs to the file and the command line, in words of the pages. @type {[RegExp, string][]} */
const SAID_HERE = [
  [/calibrate with `?rooftrack lens`?/g, "calibrate it"],
  [/write one with `?rooftrack lens`?(?: or cv2\.FileStorage)?/g, "calibrate the lens"],
  [/measure the project with `?rooftrack run`? first/g, "track first"],
  [/name the right one in inputs\.gps\.\w+ of project\.json/g, "choose the right one under Columns"],
  [/correct inputs\.gps\.file of project\.json or set inputs\.gps to null/g, "choose the record again or remove it"],
  [/correct inputs\.video or put the file there/g, "choose the video again"],
  [/or set inputs\.gps to null/g, "or remove it"],
  [/no correspondence is enabled/g, "no correspondence is in use yet"],
  [/\bin pre_event\b/g, "in the pre-event interval"],
  [/\banother pre_event\b/g, "another pre-event interval"],
  [/\bin ground_m\b/g, "on the ground"],
  [/\bin frame_px\b/g, "in the frame"],
  [/\borthoimage\.extent_m\b/g, "the orthoimage's extent"],
  [/\bid (\d+): (?:frame_px|ground_m) /g, "pair $1: "],
];
const PROJECT_FILE = /^(?:[^:]*[\\/]|[A-Za-z]:[^:]*[\\/])?project\.json: /;
// A slash after a space begins a path; one within a word, as in frames/s, does not.
const WHOLE_PATH = /(^|[\s"'`(])(?:[A-Za-z]:|\.\.)?[\\/](?:[^:;,"'`()\n]*[\\/])?([^\\/:;,"'`()\s]+)/g;
// These sentences are about the very place.
const ABOUT_FOLDERS = /lies outside the folders|absolute path|there is no such folder/;
/** @type {[RegExp, StepName][]} */
const REMEDIES = [
  [/in the inputs|under Columns|calibrate|choose the (?:video|record) again/, "inputs"],
  [/correspondence|collinear/, "correspondences"],
  [/moving region/, "regions"],
  [/track first/, "track"],
];

/** @param {string} message of the engine or the server @param {string | null} [path] the place it gives besides @returns {Told} */
export function told(message, path = null) {
  const plain = message.replace(PROJECT_FILE, "");
  const found = PLACES.find(({ place }) => place.test(plain));
  const named = found ? plain.replace(new RegExp(`${found.place.source}[.\\w[\\]]*`), found.name) : plain;
  const said = SAID_HERE.reduce((words, [theirs, ours]) => words.replace(theirs, ours), named);
  const words = ABOUT_FOLDERS.test(said) ? said : said.replace(WHOLE_PATH, "$1$2");
  const step = found?.step ?? REMEDIES.find(([remedy]) => remedy.test(words))?.[1] ?? stepOf(path);
  return { words: begun(words), step };
}

/** With a capital, unless it begins with the name of something. @param {string} words */
const begun = (words) => words.replace(/^[a-z](?=[a-z]* )/, (letter) => letter.toUpperCase());

/** @param {string | null} path place in project.json @returns {StepName | null} */
const stepOf = (path) => PLACES.find(({ place }) => place.test(path ?? ""))?.step ?? null;
