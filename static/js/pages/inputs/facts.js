// What was understood of each input, in the words of people who made the files.

import { h } from "../../lib/dom.js";
import { count, degrees, duration, fixed, metres, millimetres, pixels, size } from "../../lib/format.js";

/** @typedef {Record<string, any>} Facts */
/** @typedef {[string, string]} Fact */

/** @param {Facts} facts @returns {Fact[]} */
function video(facts) {
  return [
    [
      "Picture",
      `${facts.width} × ${facts.height} px${facts.rotation_deg ? `, turned upright by ${facts.rotation_deg}°` : ""}`,
    ],
    [
      "Frame rate",
      `${fixed(facts.rate_hz, 2)} Hz${facts.variable_rate ? ", variable: each frame's own time is used" : ""}`,
    ],
    ["Length", [duration(facts.duration_s), facts.frames && `${count(facts.frames)} frames`].filter(Boolean).join(", ")],
    ["Codec", facts.codec],
  ];
}

/** @param {Facts} facts @returns {Fact[]} */
function cloud(facts) {
  const [low, high] = facts.extent_m;
  const { ground } = facts;
  return [
    ["Points", `${count(facts.points)}, ${fixed(facts.density_per_m2, 0)} per m²`],
    ["Extent", `${fixed(high[0] - low[0], 1)} × ${fixed(high[1] - low[1], 1)} × ${metres(high[2] - low[2], 1)}`],
    [
      "Carries",
      [facts.has_color && "colour", facts.has_intensity && "intensity"].filter(Boolean).join(", ") || "positions only",
    ],
    ...(ground
      ? [
          /** @type {Fact} */ ([
            "Ground",
            `at ${metres(ground.z_m)}, spread ${millimetres(ground.spread_m, 0)}, tilt ${degrees(ground.tilt_deg, 2)}`,
          ]),
        ]
      : []),
  ];
}

/** @param {Facts} facts @returns {Fact[]} */
function lens(facts) {
  const names = ["k1", "k2", "p1", "p2", "k3"];
  return [
    ["For pictures of", facts.image_size_px.join(" × ") + " px"],
    ["Focal length", `${facts.focal_px.map((/** @type {number} */ value) => fixed(value, 1)).join(", ")} px`],
    ["Principal point", `${facts.centre_px.map((/** @type {number} */ value) => fixed(value, 1)).join(", ")} px`],
    [
      "Distortion",
      facts.distortion
        .map((/** @type {number} */ value, /** @type {number} */ i) => `${names[i]} ${fixed(value, 4)}`)
        .join(", "),
    ],
    ["Calibration RMS", facts.rms_px == null ? "not in the file" : pixels(facts.rms_px, 3)],
  ];
}

/** @param {Facts} facts @returns {Fact[]} */
function gps(facts) {
  const { columns } = facts;
  return [
    ["Record", `${count(facts.rows)} rows, ${fixed(facts.rate_hz, 1)} Hz, ${duration(facts.duration_s)}`],
    ["Columns", [columns.time, columns.x, columns.y].join(", ")],
  ];
}

const READERS = { video, cloud, lens, gps };

/** @param {keyof typeof READERS} kind @param {Facts} facts */
export function factList(kind, facts) {
  const rows = READERS[kind](facts);
  const file = /** @type {Fact} */ (["File", facts.size ? `${facts.file}, ${size(facts.size)}` : facts.file]);
  return h(
    "dl",
    { class: "facts" },
    [file, ...rows].flatMap(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]),
  );
}
