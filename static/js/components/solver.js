// Solving again after a decision that needs no video: exclusions, intervals, drift. Takes the engine a few seconds.

import { ApiError, post, projectPath } from "../lib/api.js";
import { told } from "../lib/problems.js";
import { isRunning } from "./job-card.js";
import { toast, toastError } from "./toast.js";

/** @typedef {import("./page.js").Page} Page */

/**
 * Remakes results after cheap edits, but only where they were up to date before: a measurement of the video
 * is never started without being asked for. Edits made meanwhile are solved together, once the engine is free.
 */
export class Solver {
  #busy = false;
  #again = false;

  /**
   * @param {Page} page
   * @param {() => boolean} isFresh whether results are up to date
   * @param {(busy: boolean) => void} [onBusy]
   */
  constructor(page, isFresh, onBusy = () => undefined) {
    this.page = page;
    this.isFresh = isFresh;
    this.onBusy = onBusy;
    page.events.on("job", (job) => this.#onJob(job));
  }

  /**
   * Make an edit and the results that follow from it.
   * @param {string} label
   * @param {import("../lib/store.js").Change} change
   * @param {{merge?: boolean}} [options]
   */
  async edit(label, change, options = {}) {
    const wanted = this.isFresh() || this.#busy;
    await this.page.store.edit(label, change, options);
    if (wanted) await this.#solve();
  }

  async #solve() {
    this.#again = this.#busy;
    if (this.#busy) return;
    this.#setBusy(true);
    try {
      await post(projectPath(this.page.id, "track"), {});
    } catch (error) {
      this.#again = error instanceof ApiError && error.kind === "busy";
      if (!this.#again) this.#setBusy(false);
      if (!this.#again) toastError(error);
    }
  }

  /** @param {import("../lib/types.js").Job} job */
  #onJob(job) {
    if (job.kind !== "track") return;
    this.#setBusy(isRunning(job));
    if (job.state === "failed") toast(told(job.message || "The results could not be made.").words, { tone: "bad" });
    if (!isRunning(job) && this.#again) void this.#solve();
  }

  /** @param {boolean} busy */
  #setBusy(busy) {
    this.#busy = busy;
    this.onBusy(busy);
  }
}
