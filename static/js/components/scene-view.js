// The 3D scene beside the player: camera, frame and roof lines in step with it, motion exaggerated on request.

import { post, projectPath, sentence } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { pointsShown } from "../lib/graphics.js";
import { SceneCover, sceneFrame } from "./scene-cover.js";

const LEAST_PAUSE_MS = 80;
const ASKS_AGAIN_MS = 1000;

export class SceneView {
  #active = false;
  #sending = false;
  #changed = false;
  /** Always sent whole: the server remembers nothing of earlier wishes. */
  #wish = { frame: 0, exaggeration: 1, points: 0, take: true };

  /** @param {HTMLElement} host @param {string} projectId @param {import("../lib/events.js").ServerEventStream} events */
  constructor(host, projectId, events) {
    this.host = host;
    this.projectId = projectId;
    this.amount = h("output", { class: "number", for: "exaggeration" }, "1×");
    this.slider = h("input", {
      type: "range",
      id: "exaggeration",
      min: 0,
      max: 2,
      step: 0.05,
      value: 0,
      "aria-label": "Exaggeration of the roof's motion",
      oninput: () => this.#exaggerate(),
    });
    this.cover = new SceneCover(host, projectId, () => {
      this.#wish.take = true;
      this.show(this.#wish.frame);
    });
    this.bar = h(
      "div",
      { class: "scene-bar" },
      h("label", { for: "exaggeration" }, "Motion"),
      this.slider,
      this.amount,
    );
    host.append(this.bar);
    events.on("scene", ({ owner }) => {
      if (this.cover.isElsewhere(owner)) this.cover.show({ ready: false, message: "", owner });
    });
    events.on("hello", () => this.#active && this.show(this.#wish.frame));
  }

  /** Open the scene when it is first seen. @param {boolean} active @param {number} frame */
  setActive(active, frame) {
    this.#active = active;
    if (!active) return;
    if (this.host.querySelector("iframe") === null) {
      this.host.prepend(sceneFrame("3D scene: cloud, camera and roof lines"));
    }
    this.#wish.points ||= pointsShown();
    this.show(frame);
  }

  /** 1 to 100, in even ratios along the slider. */
  get exaggeration() {
    return Number((10 ** Number(this.slider.value)).toPrecision(2));
  }

  /** Bring the scene up to the player; of several frames only the newest is sent. @param {number} frame */
  show(frame) {
    this.#wish = { ...this.#wish, frame, exaggeration: this.exaggeration };
    this.#changed = true;
    if (this.#active && !this.#sending) void this.#send();
  }

  #exaggerate() {
    this.amount.textContent = `${this.exaggeration}×`;
    this.slider.setAttribute("aria-valuetext", `${this.exaggeration} times`);
    this.show(this.#wish.frame);
  }

  async #send() {
    this.#sending = true;
    while (this.#changed && this.#active) {
      this.#changed = false;
      try {
        const answer = await post(projectPath(this.projectId, "scene"), this.#wish);
        this.cover.show(answer);
        const elsewhere = this.cover.isElsewhere(answer.owner);
        if (!elsewhere) this.#wish.take = false;
        if (!answer.ready && !elsewhere) await this.#later();
      } catch (error) {
        this.cover.tell(sentence(error));
      }
      await new Promise((resolve) => window.setTimeout(resolve, LEAST_PAUSE_MS));
    }
    this.#sending = false;
  }

  /** The cloud is still being read: ask again. */
  async #later() {
    await new Promise((resolve) => window.setTimeout(resolve, ASKS_AGAIN_MS));
    this.#changed = true;
  }
}
