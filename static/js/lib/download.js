// Handing files to a person and taking files from one.

import { h } from "./dom.js";

/** @param {string} text @param {string} name @param {string} [type] */
export function downloadText(text, name, type = "text/csv") {
  const url = URL.createObjectURL(new Blob([text], { type }));
  h("a", { href: url, download: name }).click();
  URL.revokeObjectURL(url);
}

/** Ask for files of this computer's disk through the browser. @param {{accept?: string, multiple?: boolean}} [options] @returns {Promise<File[]>} */
export function pickFiles({ accept = "", multiple = false } = {}) {
  return new Promise((resolve) => {
    const input = h("input", { type: "file", accept, multiple });
    input.addEventListener("change", () => resolve([...(input.files ?? [])]));
    input.addEventListener("cancel", () => resolve([]));
    input.click();
  });
}
