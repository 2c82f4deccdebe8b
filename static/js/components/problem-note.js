// What is wrong, in words of the pages, with the way to the step where it is put right.

import { h } from "../lib/dom.js";
import { told } from "../lib/problems.js";
import { STEPS, stepUrl } from "./header.js";
import { note } from "./notes.js";

/** @param {"info" | "warn" | "bad"} tone @param {string} message of the engine @param {import("./page.js").Page} page the way to its own step is left out */
export function problemNote(tone, message, page) {
  const { words, step } = told(message);
  const element = note(tone, words);
  if (step !== null && step !== page.step) element.append(stepLink(page.id, step));
  return element;
}

/** @param {string} id @param {import("../lib/types.js").StepName} step */
export const stepLink = (id, step) =>
  h("a", { class: "note-link", href: stepUrl(id, step) }, STEPS.find((entry) => entry.step === step)?.name ?? step);

/** For a pane without a picture: what is wrong, and the way there. @param {string} message @param {import("./page.js").Page} page @returns {(Node | string)[]} */
export function noteContent(message, page) {
  const { words, step } = told(message);
  return step === null || step === page.step ? [words] : [words, stepLink(page.id, step)];
}
