// What lies over the 3D view while it holds nothing of this project. The server has one scene for all windows: where
// another project has it, this window must not show that project's points as its own.

import { fill, h } from "../lib/dom.js";
import { noteContent } from "./problem-note.js";

/** @typedef {{ready: boolean, message: string, owner: string | null}} SceneAnswer */

// The viewer's own panel, in its own looks, holds nothing that our pages do not have.
const OWN_PANEL = '[data-floating-window]:has([data-dock-tab="viser-control-panel"])';

/** The 3D view itself, with no more on it than the scene. @param {string} title */
export function sceneFrame(title) {
  const frame = h("iframe", { class: "scene-frame", title, src: "/viser/?hideViserLogo" });
  frame.addEventListener("load", () =>
    frame.contentDocument?.head.append(h("style", {}, `${OWN_PANEL} { display: none !important; }`)),
  );
  return frame;
}

export class SceneCover {
  /** @param {HTMLElement} host what holds the 3D view @param {string} projectId @param {() => void} onTake the scene is wanted here */
  constructor(host, projectId, onTake) {
    this.host = host;
    this.projectId = projectId;
    this.onTake = onTake;
    this.note = h("div", { class: "pane-note", hidden: true, role: "status" });
    host.append(this.note);
  }

  /** Whether another project has the scene. @param {string | null | undefined} owner */
  isElsewhere(owner) {
    return owner !== null && owner !== undefined && owner !== this.projectId;
  }

  /** @param {SceneAnswer} answer */
  show({ ready, message, owner }) {
    if (this.isElsewhere(owner)) this.tell(`The 3D view shows “${owner}” in another window.`, takeButton(this.onTake));
    else if (ready) this.tell();
    else this.tell(...noteContent(message, { id: this.projectId, step: "orthoimage" }));
  }

  /** Cover the view with words; without any, uncover it. @param {...(Node | string)} content */
  tell(...content) {
    this.note.hidden = content.length === 0;
    this.host.classList.toggle("covered", content.length > 0);
    fill(this.note, ...content);
  }
}

/** @param {() => void} onTake */
const takeButton = (onTake) =>
  h("button", { class: "button small", type: "button", onclick: onTake }, "Show this project here");
