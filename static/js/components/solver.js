// Solving again after a decision that needs no video: exclusions, intervals, drift. Takes the engine about a second.

import { post, projectPath } from "../lib/api.js";
import { isRunning } from "./job-card.js";
import { toast, toastError } from "./toast.js";

/** @typedef {import("./page.js").Page} Page */

/**
 * Remakes results after cheap edits, but only where they were up to date before: a measurement of the video
 * is never started without being asked for.
 */
export class Solver {
  #busy = false;

  /** @param {Page} page @param {() => boolean} isFresh whether results are up to date */
  constructor(page, isFresh) {
    this.page = page;
    this.isFresh = isFresh;
    page.events.on("job", (job) => {
      if (job.kind !== "track") return;
      this.#busy = isRunning(job);
      if (job.state === "failed") toast(job.message ?? "The results could not be made.", { tone: "bad" });
    });
  }

  get busy() {
    return this.#busy;
  }

  /**
   * Make an edit and the results that follow from it.
   * @param {string} label
   * @param {import("../lib/store.js").Change} change
   * @param {{merge?: boolean}} [options]
   */
  async edit(label, change, options = {}) {
    const fresh = this.isFresh();
    await this.page.store.edit(label, change, options);
    if (fresh) await this.solve();
  }

  async solve() {
    try {
      await post(projectPath(this.page.id, "track"), {});
    } catch (error) {
      toastError(error);
    }
  }
}
