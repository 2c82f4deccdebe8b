// What becomes of the pairs when what they were clicked in, or brought in from, changes: a person decides.

import { h } from "../../lib/dom.js";
import { plural } from "../../lib/format.js";
import { dialogActions, openDialog } from "../../components/dialog.js";

/**
 * Another reference frame, while there are pairs.
 * @param {number} count  of pairs
 * @param {number} from
 * @param {number} to
 * @returns {Promise<"keep" | "delete" | null>}
 */
export async function askAboutPairs(count, from, to) {
  await new Promise((resolve) => setTimeout(resolve)); // the Enter that gave the number is no answer to the question
  return ask(
    `Reference frame ${to}`,
    `${plural(count, "pair")} ${count === 1 ? "was" : "were"} clicked in frame ${from}. Kept, they stay where they are ` +
      "in the picture, and hold only where the camera has not moved between the two frames.",
    { answer: "delete", label: "Delete the pairs" },
    { answer: "keep", label: "Keep the pairs" },
  );
}

/**
 * A file of pairs, while there are pairs.
 * @param {string} name  of the file
 * @param {{now: number, read: number, fresh: number}} counts  of pairs here, in the file, and in the file only
 * @returns {Promise<"replace" | "add" | null>}
 */
export function askAboutImport(name, { now, read, fresh }) {
  const known = read - fresh === 0 ? "" : ` ${read - fresh} of them ${read - fresh === 1 ? "is" : "are"} here already.`;
  return ask(
    `Import ${name}`,
    `The file holds ${plural(read, "pair")}.${known}`,
    { answer: "replace", label: `Replace the ${plural(now, "pair")} here` },
    { answer: "add", label: `Add ${plural(fresh, "pair")}` },
  );
}

/**
 * @template {string} Answer
 * @param {string} title
 * @param {string} words
 * @param {{answer: Answer, label: string}} loses  what takes pairs away
 * @param {{answer: Answer, label: string}} keeps
 * @returns {Promise<Answer | null>}
 */
function ask(title, words, loses, keeps) {
  return openDialog({
    title,
    size: "small",
    body: (/** @type {(answer: Answer | null) => void} */ close) => [
      h("div", { class: "dialog-body" }, h("p", {}, words)),
      dialogActions(
        () => close(null),
        button(loses.label, "danger", () => close(loses.answer)),
        button(keeps.label, "primary", () => close(keeps.answer)),
      ),
    ],
  });
}

/** @param {string} words @param {string} look @param {() => void} run */
const button = (words, look, run) => h("button", { class: `button ${look}`, type: "button", onclick: run }, words);
