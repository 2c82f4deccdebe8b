// One input: what it is, what was understood of it, and how to give it: by its place on this computer or by sending it.

import { fill, h } from "../../lib/dom.js";
import { pickFiles } from "../../lib/download.js";
import { icon } from "../../lib/icons.js";
import { told } from "../../lib/problems.js";
import { duration, fixed, size } from "../../lib/format.js";
import { get, isAbort, projectPath, sentence, upload } from "../../lib/api.js";
import { chooseFiles } from "../../components/file-browser.js";
import { dismissButton, note } from "../../components/notes.js";
import { toast, toastError } from "../../components/toast.js";
import { factList } from "./facts.js";

/** @typedef {"video" | "cloud" | "lens" | "gps"} InputKind */

/** @typedef {"none" | "wrong" | "reading" | "read"} InputState */

const STATES = /** @type {Record<InputState, {words: string, tone: string}>} */ ({
  none: { words: "not given", tone: "" },
  wrong: { words: "cannot be used", tone: "bad" },
  reading: { words: "being read…", tone: "accent" },
  read: { words: "understood", tone: "good" },
});

/**
 * @typedef {object} InputCardOptions
 * @property {string} projectId
 * @property {InputKind} kind
 * @property {string} title
 * @property {string} why  said while it is missing
 * @property {string} accept
 * @property {import("../../lib/icons.js").IconName} glyph
 * @property {(path: string) => Promise<void>} onPath
 * @property {() => void} onChange
 * @property {(() => Promise<void>) | null} onRemove  null where it is required
 * @property {Node[]} [more]  further actions
 */

/** @param {InputCardOptions} options */
export function inputCard(options) {
  const { kind, title, glyph, accept, onRemove, more = [] } = options;
  const badge = h("span", { class: "badge" });
  const body = h("div", { class: "input-body" });
  const transfer = h("div");
  const refusal = h("div", { class: "refusal" });
  /** What was refused stays told here until it is dismissed or something else is tried. @param {unknown} error */
  const refuse = (error) => fill(refusal, isAbort(error) ? null : refusalNote(sentence(error), () => fill(refusal)));
  const send = async (/** @type {File | undefined} */ file) => {
    if (file === undefined) return;
    fill(refusal);
    await sendInput(file, transfer, options).catch((error) => (refuse(error), toastError(error)));
  };
  const choose = async () => {
    const files = await chooseFiles({ title: `Choose the ${title.toLowerCase()}`, kind });
    if (files === null) return;
    fill(refusal);
    await options.onPath(files[0]).catch(toastError);
  };
  const pick = async () => send((await pickFiles({ accept }))[0]);
  const remove = () => void onRemove?.().catch(toastError);
  const drop = h("button", { class: "button quiet small", type: "button", hidden: true, onclick: remove }, "Remove");
  const element = h(
    "section",
    { class: "card input-card", "data-kind": kind, "aria-label": title },
    h("header", {}, icon(glyph), h("h2", {}, title), badge),
    body,
    refusal,
    transfer,
    h(
      "div",
      { class: "toolbar" },
      actionButton("folder", "Choose on this computer…", () => void choose()),
      actionButton("upload", "Upload…", () => void pick()),
      more,
      h("span", { class: "spring" }),
      drop,
    ),
  );
  acceptDrops(element, ([file]) => void send(file));
  return {
    element,
    refuse,
    /** @param {Record<string, any> | null} facts */
    show(facts) {
      const state = stateOf(facts);
      element.dataset.state = state;
      badge.className = `badge ${STATES[state].tone}`;
      badge.textContent = STATES[state].words;
      drop.hidden = facts === null || onRemove === null;
      fill(body, understood(options, facts));
    },
  };
}

/** @param {import("../../lib/icons.js").IconName} glyph @param {string} words @param {() => void} onclick */
const actionButton = (glyph, words, onclick) =>
  h("button", { class: "button small", type: "button", onclick }, icon(glyph, "small"), words);

/** @param {string} words @param {() => void} dismiss */
const refusalNote = (words, dismiss) =>
  h("div", { class: "note bad" }, icon("warn"), h("p", {}, words), dismissButton(dismiss));

/** @param {File} file @param {HTMLElement} transfer shows how far it is @param {InputCardOptions} options */
async function sendInput(file, transfer, { projectId, kind, onChange }) {
  await sendWithProgress(transfer, projectPath(projectId, `upload/${kind}`, { filename: file.name }), file);
  onChange();
  await tellUnderstood(projectId, kind, file.name).catch(toastError);
}

/** @param {Record<string, any> | null} facts @returns {InputState} */
function stateOf(facts) {
  if (facts === null) return "none";
  if (facts.error) return "wrong";
  return facts.reading ? "reading" : "read";
}

/** @param {InputCardOptions} options @param {Record<string, any> | null} facts @returns {import("../../lib/dom.js").Child[]} */
function understood({ projectId, kind, why }, facts) {
  if (facts === null) return [h("p", { class: "soft" }, why)];
  const path = h("p", { class: "path" }, facts.file);
  if (facts.error) return [path, h("p", { class: "note bad" }, icon("warn"), h("span", {}, told(facts.error.message).words))];
  if (facts.reading) return [path, h("progress", { "aria-label": "Reading" })];
  return [
    factList(kind, facts),
    kind === "video" && still(projectId, facts.file),
    ...(facts.warnings ?? []).map((/** @type {string} */ words) => note("warn", told(words).words)),
    ...(facts.notes ?? []).map((/** @type {string} */ words) => note("info", told(words).words)),
  ];
}

/** @param {string} projectId @param {string} file changes the address with the video */
const still = (projectId, file) =>
  h("img", {
    class: "still",
    alt: "First frame",
    src: `/api/${projectPath(projectId, "frames/0.jpg", { w: 480, v: file })}`,
  });

/** Say that a file is understood, once it is; what is wrong with one stands on its card. @param {string} projectId @param {InputKind} kind @param {string} name */
async function tellUnderstood(projectId, kind, name) {
  const facts = (await get(projectPath(projectId, "inputs")))[kind];
  if (facts === null || facts.error) return;
  if (facts.reading) toast(`${name} is here and being read.`);
  else toast(`${name} is understood.`, { tone: "good" });
}

/** Stream a file, showing how far it is, with a way to stop. @param {HTMLElement} place @param {string} path @param {File} file */
export async function sendWithProgress(place, path, file) {
  const cancel = new AbortController();
  const bar = h("progress", { max: 1, value: 0, "aria-label": `Sending ${file.name}` });
  const words = h("span", { class: "numbers number" });
  const stop = h(
    "button",
    { class: "button small", type: "button", onclick: () => cancel.abort() },
    icon("close", "small"),
    "Cancel",
  );
  fill(
    place,
    h(
      "div",
      { class: "job" },
      h("div", { class: "job-head" }, h("strong", {}, `Sending ${file.name}`), words, stop),
      bar,
    ),
  );
  const began = performance.now();
  try {
    return await upload(
      "PUT",
      path,
      file,
      (sent, total) => {
        const speed = sent / Math.max(0.001, (performance.now() - began) / 1000);
        bar.value = total === 0 ? 1 : sent / total;
        words.textContent = `${size(sent)} of ${size(total)} · ${fixed(speed / 1e6, 1)} MB/s · ${duration((total - sent) / speed)} left`;
      },
      cancel.signal,
    );
  } finally {
    fill(place);
  }
}

/** Files dropped on an element. @param {HTMLElement} element @param {(files: File[]) => void} take */
function acceptDrops(element, take) {
  element.addEventListener("dragover", (event) => {
    event.preventDefault();
    element.classList.add("dropping");
  });
  element.addEventListener("dragleave", () => element.classList.remove("dropping"));
  element.addEventListener("drop", (event) => {
    event.preventDefault();
    element.classList.remove("dropping");
    const files = [...(event.dataTransfer?.files ?? [])];
    if (files.length > 0) take(files);
  });
}
