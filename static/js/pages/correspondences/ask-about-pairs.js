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
  return openDialog({
    title: `Reference frame ${to}`,
    size: "small",
    body: (close) => [
      h(
        "div",
        { class: "dialog-body" },
        h(
          "p",
          {},
          `${plural(count, "pair")} ${count === 1 ? "was" : "were"} clicked in frame ${from}. Kept, they stay where they are ` +
            "in the picture, and hold only where the camera has not moved between the two frames.",
        ),
      ),
      dialogActions(
        () => close(null),
        button("Delete the pairs", "danger", () => close("delete")),
        button("Keep the pairs", "primary", () => close("keep")),
      ),
    ],
  });
}

/** @param {string} words @param {string} look @param {() => void} run */
const button = (words, look, run) => h("button", { class: `button ${look}`, type: "button", onclick: run }, words);
