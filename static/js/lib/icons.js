// Line icons on a 16 px grid, our own drawings. They inherit colour and never carry meaning alone.

import { svg } from "./dom.js";

const PATHS = {
  add: "M8 3v10M3 8h10",
  archive: "M2.5 3.5h11v3h-11zM3.5 6.5v6h9v-6M6.5 9h3",
  arrow_left: "M9.5 3.5 5 8l4.5 4.5",
  arrow_right: "M6.5 3.5 11 8l-4.5 4.5",
  blend: "M6 8a4 4 0 1 0 8 0 4 4 0 1 0-8 0M2 8a4 4 0 1 0 8 0 4 4 0 1 0-8 0",
  check: "m3.5 8.5 3 3 6-7",
  clock: "M8 2.2a5.8 5.8 0 1 0 .01 0M8 5v3.2l2.2 1.4",
  close: "m4 4 8 8M12 4l-8 8",
  copy: "M5.5 5.5h8v8h-8zM10.5 5.5v-3h-8v8h3",
  cube: "M8 1.8 13.5 5v6L8 14.2 2.5 11V5zM2.7 5 8 8l5.3-3M8 8v6",
  download: "M8 2.5v7.5M4.8 7 8 10.2 11.2 7M3 13.5h10",
  edit: "M10.8 2.8 13.2 5.2 5.5 13l-3 .5.5-3z",
  expand: "M9.5 2.5h4v4M6.5 13.5h-4v-4M13.5 2.5 9 7M2.5 13.5 7 9",
  file: "M4 1.8h5l3.2 3.2v9.2H4zM9 1.8V5h3.2",
  fit: "M2.5 6v-3.5h3.5M13.5 6v-3.5h-3.5M2.5 10v3.5h3.5M13.5 10v3.5h-3.5",
  folder: "M1.8 4h4.4l1.5 1.8h6.5v7H1.8z",
  help: "M8 1.8a6.2 6.2 0 1 0 .01 0M6.3 6.3A1.75 1.75 0 1 1 8.6 8c-.4.2-.6.5-.6.9v.4M8 11.5v.01",
  height: "M8 2v12M5.5 4.5 8 2l2.5 2.5M5.5 11.5 8 14l2.5-2.5",
  info: "M8 1.8a6.2 6.2 0 1 0 .01 0M8 7.4v3.6M8 5v.01",
  link: "M6.8 9.2a2.6 2.6 0 0 0 3.7 0l2.2-2.2a2.6 2.6 0 0 0-3.7-3.7L8 4.3M9.2 6.8a2.6 2.6 0 0 0-3.7 0L3.3 9a2.6 2.6 0 0 0 3.7 3.7l1-1",
  lock: "M3.5 7.2h9v6.3h-9zM5.3 7.2V5a2.7 2.7 0 0 1 5.4 0v2.2",
  minus: "M4 8h8",
  moon: "M13 9.7A5.6 5.6 0 1 1 6.3 3 4.5 4.5 0 0 0 13 9.7z",
  more: "M3.5 8v.01M8 8v.01M12.5 8v.01",
  pause: "M5.5 3.5v9M10.5 3.5v9",
  play: "M5 3.2v9.6L12.5 8z",
  polygon: "M3 5.5 8.5 2.5l5 4-2 6.5H4.5z",
  redo: "M10 3.5 13 6.5l-3 3M13 6.5H6.5a3.5 3.5 0 0 0 0 7H9",
  refresh: "M13 8a5 5 0 1 1-1.6-3.7M13.2 2.2v2.9h-2.9",
  running: "M8 2.2a5.8 5.8 0 1 1-5.8 5.8",
  stale: "M13 8a5 5 0 1 1-1.6-3.7M13.2 2.2v2.9h-2.9",
  sun: "M8 5.2a2.8 2.8 0 1 0 .01 0M8 1.2v1.3M8 13.5v1.3M1.2 8h1.3M13.5 8h1.3M3.2 3.2l.9.9M11.9 11.9l.9.9M3.2 12.8l.9-.9M11.9 4.1l.9-.9",
  swipe: "M8 2v12M5.5 6 3 8l2.5 2M10.5 6 13 8l-2.5 2",
  target: "M8 3.5a4.5 4.5 0 1 0 .01 0M8 1v4M8 11v4M1 8h4M11 8h4",
  trash: "M2.8 4.2h10.4M6.2 4.2V2.5h3.6v1.7M4 4.2l.7 9.3h6.6l.7-9.3M6.6 6.8v4M9.4 6.8v4",
  undo: "M6 3.5 3 6.5l3 3M3 6.5h6.5a3.5 3.5 0 0 1 0 7H7",
  upload: "M8 10.2V2.5M4.8 5.7 8 2.5l3.2 3.2M3 13.5h10",
  video: "M1.8 4h8.7v8H1.8zM10.5 7l3.7-2.2v6.4L10.5 9z",
  warn: "M8 2.3 14.3 13.3H1.7zM8 6.5v3.2M8 11.5v.01",
  width: "M2 8h12M4.5 5.5 2 8l2.5 2.5M11.5 5.5 14 8l-2.5 2.5",
  zoom_in: "M7 2.5a4.5 4.5 0 1 0 .01 0M10.3 10.3 13.8 13.8M7 5v4M5 7h4",
};

/** @typedef {keyof typeof PATHS} IconName */

/** @param {IconName} name @param {string} [extra] more classes */
export function icon(name, extra = "") {
  return svg(
    "svg",
    { class: `icon ${extra}`, viewBox: "0 0 16 16", "aria-hidden": "true" },
    svg("path", { d: PATHS[name] }),
  );
}
