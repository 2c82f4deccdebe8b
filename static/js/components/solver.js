// Solving again after a decision that needs no video: exclusions, intervals, drift. Takes the engine a few seconds.

import { ApiError, post, projectPath } from "../lib/api.js";
import { told } from "../lib/problems.js";
import { fetchResults } from "./histories.js";
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
  #following = false;

  /**
   * @param {Page} page
   * @param {object} options
   * @param {() => boolean} options.isFresh whether results are up to date
   * @param {(busy: boolean) => void} options.onBusy
   * @param {() => Promise<void>} options.reload the project has changed, and nobody makes results of it: show what there is
   */
  constructor(page, { isFresh, onBusy, reload }) {
    this.page = page;
    this.isFresh = isFresh;
    this.onBusy = onBusy;
    this.reload = reload;
    page.events.on("job", (job) => this.#onJob(job));
    page.store.on("change", (change) => void this.#onChange(change).catch(toastError));
  }

  /**
   * Make an edit and the results that follow from it.
   * @param {string} label
   * @param {import("../lib/store.js").Change} change
   * @param {{merge?: boolean}} [options]
   */
  async edit(label, change, options = {}) {
    const wanted = this.isFresh() || this.#busy;
    const { revision } = this.page.store;
    await this.page.store.edit(label, change, options);
    if (wanted && this.page.store.revision !== revision) await this.#solve(); // else it was not saved
  }

  /** @param {import("../lib/store.js").StoreEvents["change"]} change */
  async #onChange({ origin, project, previous }) {
    if (origin === "undo") return this.#follow();
    const elsewhere = origin === "server" && JSON.stringify(project) !== JSON.stringify(previous);
    if (elsewhere || (origin === "saved" && !this.#busy && !this.isFresh())) await this.reload();
  }

  /** After undo or redo: results that were up to date are made so again, as after an edit, where that takes no video. */
  async #follow() {
    const wanted = this.isFresh() || this.#busy || this.#following;
    this.#following = true;
    try {
      const { stale, measured } = await fetchResults(this.page.id);
      if (wanted && stale && measured.includes(this.page.store.project.method)) await this.#solve();
      else await this.reload();
    } finally {
      this.#following = false;
    }
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
