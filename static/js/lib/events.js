// What the server tells on its own: progress of jobs, edits from other tabs, places picked in 3D.
// A hidden tab lets go of its connection (browsers allow six per host) and catches up when it is seen again.
// A connection that is lost is opened again for as long as it takes, and the page is told: a page that does not know
// that its server is gone shows progress that is none.

import { Emitter } from "./emitter.js";
import { projectPath, TRIES_AGAIN_MS } from "./api.js";

/**
 * @typedef {object} ServerEvents
 * @property {{revision: number, job: import("./types.js").Job | null}} hello
 * @property {import("./types.js").Job} job
 * @property {{revision: number, label?: string}} project
 * @property {{kind: string}} inputs
 * @property {{ready: boolean}} orthoimage
 * @property {object} results
 * @property {any} track
 * @property {{xyz_m?: [number, number, number], height_m?: number, spread_m?: number | null, points?: number, message?: string}} pick
 * @property {{owner: string | null, frame?: number | null}} scene which project the 3D view holds now
 * @property {null} offline the server does not answer
 * @property {null} online it answers again
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
  #opened = false;
  #trying = 0;
  online = true;

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
    window.clearTimeout(this.#trying);
    if (this.#source !== null) return;
    const source = new EventSource(this.url);
    this.#source = source;
    source.onopen = () => {
      this.#opened = true;
      this.#tell(true);
    };
    source.onerror = () => this.#lost();
    for (const name of NAMES) {
      source.addEventListener(name, (event) =>
        this.emit(name, JSON.parse(/** @type {MessageEvent} */ (event).data)),
      );
    }
  }

  #close() {
    window.clearTimeout(this.#trying);
    this.#source?.close();
    this.#source = null;
  }

  /** A stream that the server ended opens again at once; one that does not open is a server that does not answer. */
  #lost() {
    const again = this.#opened;
    this.#opened = false;
    this.#close();
    if (!again) this.#tell(false);
    this.#trying = window.setTimeout(() => this.#open(), again ? 0 : TRIES_AGAIN_MS);
  }

  /** @param {boolean} online */
  #tell(online) {
    if (online === this.online) return;
    this.online = online;
    this.emit(online ? "online" : "offline", null);
  }
}
