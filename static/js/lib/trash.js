// Deleted projects: kept for a while, and fetched back from there.

import { get, post } from "./api.js";

/** @typedef {{undo_token: string, id: string, name: string, deleted_s: number, kept_until_s: number}} Deleted */

/** @returns {Promise<Deleted[]>} the last deleted first */
export const deletedProjects = () => get("trash");

/** @param {string} undo_token @returns {Promise<{id: string}>} the project, under another id where its own is taken */
export const undelete = (undo_token) => post("projects/untrash", { undo_token });
