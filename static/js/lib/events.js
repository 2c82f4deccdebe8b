// What the server tells on its own: progress of jobs, edits from other tabs, places picked in 3D.
// A hidden tab lets go of its connection (browsers allow six per host) and catches up when it is seen again.

import { Emitter } from "./emitter.js";
import { projectPath } from "./api.js";

/**
 * @typedef {object} ServerEvents
 * @property {{revision: number, job: import("./types.js").Job | null}} hello
 * @property {import("./types.js").Job} job
 * @property {{revision: number, label?: string}} project
 * @property {{kind: string}} inputs
 * @property {{ready: boolean}} orthoimage
 * @property {object} results
 * @property {any} track
 * @property {{xyz_m?: [number, number, number], height_m?: number, spread_m?: number, points?: number, message?: string}} pick
 * @property {{owner: string | null, frame?: number | null}} scene which project the 3D view holds now
 */

const NAMES = /** @type {const} */ ([
  "hello",
  "job",
  "project",
  "inputs",
  "orthoimage",
  "results",
  "track",
  "pick",
  "scene",
]);

/** @extends {Emitter<ServerEvents>} */
export class ServerEventStream extends Emitter {
  /** @type {EventSource | null} */
  #source = null;

  /** @param {string} projectId */
  constructor(projectId) {
    super();
    this.url = `/api/${projectPath(projectId, "events")}`;
    document.addEventListener("visibilitychange", () => (document.hidden ? this.#close() : this.#open()));
    window.addEventListener("pagehide", () => this.#close());
    window.addEventListener("pageshow", () => this.#open());
    if (!document.hidden) this.#open();
  }

  #open() {
    if (this.#source !== null) return;
    this.#source = new EventSource(this.url);
    for (const name of NAMES) {
      this.#source.addEventListener(name, (event) =>
        this.emit(name, JSON.parse(/** @type {MessageEvent} */ (event).data)),
      );
    }
  }

  #close() {
    this.#source?.close();
    this.#source = null;
  }
}
