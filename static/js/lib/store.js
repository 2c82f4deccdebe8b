// The project as this tab knows it. An edit shows at once, is saved at once, and is one step of the server's history.
// Edits wait for each other, so the revision is always the one the server gave last; an edit on top of somebody
// else's newer state is refused by the server (409), and told, not obeyed. A server that does not answer loses none:
// they stay as they are shown, and are saved as soon as it does.

import { Emitter } from "./emitter.js";
import { ApiError, get, isConflict, isOffline, post, projectPath, put, untilNextTry } from "./api.js";

/** @typedef {import("./types.js").Project} Project */
/** @typedef {import("./types.js").ProjectState} ProjectState */
/** @typedef {(draft: Project) => void} Change */
/** @typedef {{label: string, change: Change, merge: boolean}} Edit */
/** @typedef {"saved" | "saving" | "waiting" | "failed"} Saving  waiting: for a server that does not answer */

/**
 * @typedef {object} StoreEvents
 * @property {{project: Project, previous: Project, origin: "edit" | "saved" | "server" | "undo"}} change
 * @property {Saving} saving
 * @property {{labels: string[], error: unknown, again: () => void}} lost  taken back for no fault of theirs: another tab was faster; `again` repeats them in order on the newest state
 * @property {{which: "undo" | "redo", label: string}} stepped back or forward over the edit of that label
 * @property {{label: string, error: unknown}} refused  the server found the edit wrong; it was taken back, those behind it go on
 */

/** @extends {Emitter<StoreEvents>} */
export class ProjectStore extends Emitter {
  /** @type {Edit[]} */
  #waiting = [];
  /** @type {Promise<void>} */
  #work = Promise.resolve();
  #busy = false;
  /** Edits that nobody answered for yet. */
  #unsaved = 0;
  /** Highest revision told of while busy; whether it is our own shows when the answer is here. */
  #heard = 0;

  /** @param {ProjectState} state */
  constructor(state) {
    super();
    this.state = state;
    this.project = state.project;
  }

  /** @param {string} id */
  static async open(id) {
    return new ProjectStore(await get(projectPath(id)));
  }

  get id() {
    return this.state.id;
  }

  get hasUnsaved() {
    return this.#unsaved > 0;
  }

  get revision() {
    return this.state.revision;
  }

  /**
   * Change the project. `change` mutates a draft; it may run again on a newer state.
   * @param {string} label what undo will be called: "Move pair 3"
   * @param {Change} change
   * @param {{merge?: boolean}} [options] merge: one undo step with the edit before, when that has the same label (nudges, sliders)
   * @returns {Promise<void>} when saved or refused
   */
  edit(label, change, { merge = false } = {}) {
    const previous = this.project;
    this.project = changed(previous, change);
    const last = this.#waiting.at(-1);
    if (merge && last?.merge && last.label === label) last.change = inOrder(last.change, change);
    else this.#waiting.push({ label, change, merge });
    this.emit("change", { project: this.project, previous, origin: "edit" });
    return this.#saveAll();
  }

  /** @returns {Promise<void>} */
  undo() {
    return this.#step("undo");
  }

  /** @returns {Promise<void>} */
  redo() {
    return this.#step("redo");
  }

  /** Take what the server has now. @returns {Promise<void>} */
  refresh() {
    return this.#then(async () => this.#adopt(await get(projectPath(this.id)), "server"));
  }

  /** Told by the event stream that a revision exists. @param {number} revision */
  heardOf(revision) {
    if (this.#busy) this.#heard = Math.max(this.#heard, revision);
    else if (revision !== this.revision)
      this.refresh().catch(() => undefined); // without a server the stream breaks too, and tells again
  }

  /** Resolves when nothing waits to be saved. @returns {Promise<void>} */
  settled() {
    return this.#work;
  }

  /** @param {"undo" | "redo"} which */
  #step(which) {
    return this.#then(async () => {
      const label = this.state[`${which}_label`];
      if (label === null) return; // asked for faster than answered: those before took the last one
      try {
        this.#adopt(await post(projectPath(this.id, which), { revision: this.revision }), "undo");
        this.emit("stepped", { which, label });
      } catch (error) {
        if (!isConflict(error)) throw error;
        await this.#reload();
        this.emit("lost", { labels: [which], error, again: () => void this.#step(which) });
      }
    });
  }

  #saveAll() {
    this.#unsaved += 1;
    const saving = this.#then(async () => {
      while (this.#waiting.length > 0) await this.#save(/** @type {Edit} */ (this.#waiting.shift()));
    });
    return saving.finally(() => (this.#unsaved -= 1));
  }

  /** @param {Edit} edit */
  async #save(edit) {
    this.emit("saving", "saving");
    let state;
    try {
      state = await this.#stored(edit);
    } catch (error) {
      return this.#takeBack(edit, error);
    }
    this.#adopt({ ...this.state, ...state }, "saved");
    this.emit("saving", "saved");
  }

  /** The state with an edit in it, however long the server takes to answer. @param {Edit} edit @returns {Promise<ProjectState>} */
  async #stored({ label, change, merge }) {
    const edited = { project: changed(this.state.project, change), revision: this.revision, label, merge };
    for (let isFirst = true; ; isFirst = false) {
      try {
        return (isFirst ? null : await this.#takenUnheard(label)) ?? (await put(projectPath(this.id), edited));
      } catch (error) {
        if (!isOffline(error)) throw error;
        this.emit("saving", "waiting");
        await untilNextTry();
      }
    }
  }

  /** An edit may have been taken though its answer never came: it is the newest one then. @param {string} label @returns {Promise<ProjectState | null>} */
  async #takenUnheard(label) {
    const state = /** @type {ProjectState} */ (await get(projectPath(this.id)));
    return state.revision === this.revision + 1 && state.undo_label === label ? state : null;
  }

  /** A wrong edit goes alone. Else those behind it go with it: they were made on a state that is shown no more. @param {Edit} edit @param {unknown} error */
  async #takeBack(edit, error) {
    const wrong = error instanceof ApiError && error.kind === "input";
    const lost = wrong ? [edit] : [edit, ...this.#waiting.splice(0)];
    await this.#reload();
    if (wrong) this.emit("refused", { label: edit.label, error });
    else this.emit("lost", { labels: lost.map(({ label }) => label), error, again: () => this.#repeat(lost) });
  }

  /** @param {Edit[]} edits */
  #repeat(edits) {
    for (const { label, change, merge } of edits) void this.edit(label, change, { merge });
  }

  async #reload() {
    try {
      this.#adopt(await get(projectPath(this.id)), "server");
      this.emit("saving", "saved");
    } catch {
      this.project = this.state.project;
      this.emit("change", { project: this.project, previous: this.project, origin: "server" });
      this.emit("saving", "failed");
    }
  }

  /** @param {ProjectState} state @param {"saved" | "server" | "undo"} origin */
  #adopt(state, origin) {
    const previous = this.project;
    this.state = state;
    this.project = this.#waiting.reduce((project, edit) => changed(project, edit.change), state.project);
    this.emit("change", { project: this.project, previous, origin });
  }

  /** Queue work behind all earlier work. @param {() => Promise<void>} task @returns {Promise<void>} */
  #then(task) {
    const result = this.#work.then(async () => {
      this.#busy = true;
      try {
        await task();
      } finally {
        this.#busy = false;
        this.#catchUp();
      }
    });
    this.#work = result.catch(() => undefined);
    return result;
  }

  /** Take what others saved while we were busy. Once only: a server that went back would never reach what was heard. */
  #catchUp() {
    const heard = this.#heard;
    this.#heard = 0;
    if (heard > this.revision) this.heardOf(heard);
  }
}

/** @param {Project} project @param {Change} change @returns {Project} */
function changed(project, change) {
  const draft = structuredClone(project);
  change(draft);
  return draft;
}

/** @param {Change} first @param {Change} second @returns {Change} */
const inOrder = (first, second) => (draft) => {
  first(draft);
  second(draft);
};
