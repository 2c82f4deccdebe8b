// What is wrong, in words of the pages, with the way to the step where it is put right.

import { ApiError } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { told } from "../lib/problems.js";
import { STEPS, stepUrl } from "./header.js";
import { note } from "./notes.js";

/** @typedef {import("../lib/types.js").StepName} StepName */

/** @param {"info" | "warn" | "bad"} tone @param {string} message of the engine @param {import("./page.js").Page} page the way to its own step is left out */
export function problemNote(tone, message, page) {
  const { words, step } = told(message);
  const element = note(tone, words);
  if (step !== null && step !== page.step) element.append(stepLink(page.id, step));
  return element;
}

/** @param {StepName} step */
const nameOf = (step) => STEPS.find((entry) => entry.step === step)?.name ?? step;
/** @param {string} id @param {StepName} step */
const stepLink = (id, step) => h("a", { class: "note-link", href: stepUrl(id, step) }, nameOf(step));

/** For a pane without a picture: what is wrong, and the way there. @param {unknown} error @param {{id: string, step: StepName}} page @returns {(Node | string)[]} */
export function noteContent(error, page) {
  const message = error instanceof Error ? error.message : String(error);
  const { words, step } = told(message, error instanceof ApiError ? error.path : null);
  return step === null || step === page.step ? [words] : [words, stepButton(page.id, step)];
}

/** A button on a pane that leads to a step. @param {string} id @param {StepName} step @param {string} [words] */
export const stepButton = (id, step, words = nameOf(step)) =>
  h("a", { class: "button primary", href: stepUrl(id, step) }, words);
