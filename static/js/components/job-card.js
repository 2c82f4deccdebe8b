// Progress of a running job: what it does, how far, how fast, how long still, and a way to stop it.

import { fill, h } from "../lib/dom.js";
import { icon } from "../lib/icons.js";
import { told } from "../lib/problems.js";
import { count, duration, fixed } from "../lib/format.js";
import { remove } from "../lib/api.js";
import { toastError } from "./toast.js";

/** @typedef {import("../lib/types.js").Job} Job */

/** What the engine calls its stages, in words of the pages. @type {Record<string, string>} */
const STAGES = {
  cloud: "Reading the cloud",
  measuring: "Measuring frames",
  solving: "Solving",
  orthoimage: "Making the orthoimage",
  "drawing figures": "Drawing figures",
  calibration: "Looking at the pictures",
};

/** What a running job is doing. @param {Job} job */
export const stageWords = (job) => STAGES[job.stage] ?? (job.stage || "Starting");

/** Whether a job still works. @param {Job | null} job */
export const isRunning = (job) => job !== null && job.state === "running";

/** A card that shows a job while it runs, and why it failed. Empty and hidden otherwise. @param {{unit?: string}} [options] unit: of done and total ("frames") */
export function jobCard({ unit = "" } = {}) {
  const element = h("div", { class: "job", hidden: true });
  const bar = h("progress", { max: 1, "aria-label": "Progress" });
  const stage = h("strong");
  const numbers = h("span", { class: "numbers number" });
  const cancel = h("button", { class: "button small", type: "button" }, icon("close", "small"), "Cancel");
  /** @type {Job | null} */
  let shown = null;
  cancel.addEventListener("click", () => {
    if (shown === null) return;
    cancel.disabled = true;
    remove(`jobs/${shown.id}`).catch((error) => {
      cancel.disabled = false;
      toastError(error);
    });
  });
  fill(element, h("div", { class: "job-head" }, stage, numbers, cancel), bar);
  return {
    element,
    /** @param {Job | null} job */
    show(job) {
      if (job?.id !== shown?.id) cancel.disabled = false;
      shown = job;
      const failed = job?.state === "failed";
      element.hidden = job === null || (!isRunning(job) && !failed);
      if (job === null) return;
      element.classList.toggle("failed", failed);
      cancel.hidden = !isRunning(job);
      bar.hidden = failed;
      stage.textContent = failed ? told(job.message || "Failed").words : stageWords(job);
      numbers.textContent = isRunning(job) ? progressWords(job, unit) : "";
      if (job.total > 0) bar.value = job.done / job.total;
      else bar.removeAttribute("value");
    },
  };
}

/** @param {Job} job @param {string} unit */
function progressWords(job, unit) {
  const words = [];
  if (job.total > 0 && unit !== "") words.push(`${count(job.done)} of ${count(job.total)} ${unit}`);
  else if (job.total > 0) words.push(`${fixed((100 * job.done) / job.total, 0)} %`);
  if (job.rate_per_s && unit !== "") words.push(`${fixed(job.rate_per_s, 1)} ${unit}/s`);
  if (job.seconds_left !== null && job.seconds_left !== undefined) words.push(`${duration(job.seconds_left)} left`);
  return words.join(" · ");
}
