// One input: what it is, what was understood of it, and how to give it: by its place on this computer or by sending it.

import { fill, h } from "../../lib/dom.js";
import { pickFiles } from "../../lib/download.js";
import { icon } from "../../lib/icons.js";
import { told } from "../../lib/problems.js";
import { duration, fixed, size } from "../../lib/format.js";
import { get, projectPath, upload } from "../../lib/api.js";
import { chooseFiles } from "../../components/file-browser.js";
import { toast, toastError } from "../../components/toast.js";
import { factList } from "./facts.js";

/** @typedef {"video" | "cloud" | "lens" | "gps"} InputKind */

/**
 * @param {object} options
 * @param {string} options.projectId
 * @param {InputKind} options.kind
 * @param {string} options.title
 * @param {string} options.why  said while it is missing
 * @param {string} options.accept
 * @param {import("../../lib/icons.js").IconName} options.glyph
 * @param {(path: string) => Promise<void>} options.onPath
 * @param {() => void} options.onChange
 * @param {(() => Promise<void>) | null} options.onRemove  null where it is required
 * @param {Node[]} [options.more]  further actions
 */
export function inputCard({ projectId, kind, title, why, accept, glyph, onPath, onChange, onRemove, more = [] }) {
  const badge = h("span", { class: "badge" });
  const body = h("div", { class: "input-body" });
  const transfer = h("div");
  const browse = h(
    "button",
    { class: "button small", type: "button" },
    icon("folder", "small"),
    "Choose on this computer…",
  );
  const send = h("button", { class: "button small", type: "button" }, icon("upload", "small"), "Upload…");
  const drop = h("button", { class: "button quiet small", type: "button", hidden: true }, "Remove");
  const element = h(
    "section",
    { class: "card input-card", "data-kind": kind, "aria-label": title },
    h("header", {}, icon(glyph), h("h2", {}, title), badge),
    body,
    transfer,
    h("div", { class: "toolbar" }, browse, send, more, h("span", { class: "spring" }), drop),
  );

  browse.addEventListener("click", async () => {
    const files = await chooseFiles({ title: `Choose the ${title.toLowerCase()}`, kind });
    if (files !== null) await onPath(files[0]).catch(toastError);
  });
  send.addEventListener("click", async () => {
    const [file] = await pickFiles({ accept });
    if (file !== undefined) await sendFile(file);
  });
  drop.addEventListener("click", () => void onRemove?.().catch(toastError));
  acceptDrops(element, (files) => void sendFile(files[0]));

  const sendFile = async (/** @type {File} */ file) => {
    try {
      await sendWithProgress(transfer, projectPath(projectId, `upload/${kind}`, { filename: file.name }), file);
      onChange();
      await tellUnderstood(projectId, kind, file.name);
    } catch (error) {
      toastError(error);
    }
  };
  return {
    element,
    /** @param {Record<string, any> | null} facts */
    show(facts) {
      const state = facts === null ? "none" : facts.error ? "wrong" : facts.reading ? "reading" : "read";
      element.dataset.state = state;
      badge.className = `badge ${{ none: "", wrong: "bad", reading: "accent", read: "good" }[state]}`;
      badge.textContent = { none: "not given", wrong: "cannot be used", reading: "being read…", read: "understood" }[
        state
      ];
      drop.hidden = facts === null || onRemove === null;
      if (facts === null) fill(body, h("p", { class: "soft" }, why));
      else if (facts.error)
        fill(
          body,
          h("p", { class: "path" }, facts.file),
          h("p", { class: "note bad" }, icon("warn"), h("span", {}, told(facts.error.message).words)),
        );
      else if (facts.reading)
        fill(body, h("p", { class: "path" }, facts.file), h("progress", { "aria-label": "Reading" }));
      else
        fill(
          body,
          factList(kind, facts),
          kind === "video" &&
            h("img", {
              class: "still",
              alt: "First frame",
              src: `/api/${projectPath(projectId, "frames/0.jpg", { w: 480, v: facts.file })}`,
            }),
        );
    },
  };
}

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
export function acceptDrops(element, take) {
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
