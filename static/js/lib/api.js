// Every word exchanged with the server goes through here. Errors arrive as one sentence of the engine.

import { told } from "./problems.js";

const GUARD = { "X-Rooftrack": "1" };
/** A server that does not answer is asked again after so long. */
export const TRIES_AGAIN_MS = 1500;

/** What the server refused, in the engine's own sentence. */
export class ApiError extends Error {
  /** @param {number} status @param {{message: string, path?: string | null, kind?: string, problems?: string[]}} error @param {any} [body] */
  constructor(status, error, body = null) {
    super(error.message);
    this.name = "ApiError";
    this.status = status;
    this.path = error.path ?? null;
    this.kind = error.kind ?? "internal";
    this.problems = error.problems ?? [];
    this.body = body;
  }
}

/**
 * @param {string} method
 * @param {string} path below /api
 * @param {{json?: unknown, body?: BodyInit, signal?: AbortSignal}} [options]
 * @returns {Promise<any>}
 */
async function request(method, path, { json, body, signal } = {}) {
  const headers = new Headers(method === "GET" ? {} : GUARD);
  if (json !== undefined) headers.set("Content-Type", "application/json");
  const init = { method, headers, body: json === undefined ? body : JSON.stringify(json), signal };
  const response = await fetched(`/api/${path}`, init);
  return answer(response.status, await response.text());
}

/** @param {string} url @param {RequestInit} init */
async function fetched(url, init) {
  try {
    return await fetch(url, init);
  } catch (error) {
    if (isAbort(error)) throw error;
    throw new ApiError(0, { message: "The Rooftrack server does not answer. Is it still running?", kind: "offline" });
  }
}

/** @param {number} status @param {string} text */
function answer(status, text) {
  let body = null;
  try {
    body = text === "" ? null : JSON.parse(text);
  } catch {
    body = null;
  }
  if (status >= 200 && status < 300) return body;
  throw new ApiError(status, body?.error ?? { message: `The server answered ${status} without a reason.` }, body);
}

/** @param {string} path @param {AbortSignal} [signal] */
export const get = (path, signal) => request("GET", path, { signal });
/** @param {string} path @param {unknown} [json] @param {AbortSignal} [signal] */
export const post = (path, json = {}, signal) => request("POST", path, { json, signal });
/** @param {string} path @param {unknown} json */
export const put = (path, json) => request("PUT", path, { json });
/** @param {string} path */
export const remove = (path) => request("DELETE", path);

/** A picture of the server's. @param {string} url @param {AbortSignal} [signal] */
export async function picture(url, signal) {
  const response = await fetched(url, { signal });
  if (!response.ok) answer(response.status, await response.text());
  return createImageBitmap(await response.blob());
}

/** Path of a project's resource, with query. @param {string} id @param {string} [rest] @param {Record<string, string | number | boolean | null | undefined>} [query] */
export function projectPath(id, rest = "", query = {}) {
  const given = Object.entries(query).filter(([, value]) => value !== null && value !== undefined);
  const search = new URLSearchParams(given.map(([name, value]) => [name, String(value)])).toString();
  return `projects/${encodeURIComponent(id)}${rest === "" ? "" : `/${rest}`}${search === "" ? "" : `?${search}`}`;
}

/**
 * Stream a file from disk, never holding it in memory. Aborting leaves nothing behind on the server. Whoever leaves the
 * page meanwhile is asked first.
 * @param {"PUT" | "POST"} method
 * @param {string} path
 * @param {Blob} file
 * @param {(sent: number, total: number) => void} onProgress bytes
 * @param {AbortSignal} [signal]
 * @returns {Promise<any>}
 */
export function upload(method, path, file, onProgress, signal) {
  return new Promise((resolve, reject) => {
    const transfer = new XMLHttpRequest();
    transfer.open(method, `/api/${path}`);
    for (const [name, value] of Object.entries(GUARD)) transfer.setRequestHeader(name, value);
    transfer.upload.onprogress = (event) => onProgress(event.loaded, file.size);
    transfer.onload = () => {
      try {
        resolve(answer(transfer.status, transfer.responseText));
      } catch (error) {
        reject(error);
      }
    };
    transfer.onerror = () =>
      reject(new ApiError(0, { message: "The upload broke off; nothing was kept. Try again.", kind: "offline" }));
    transfer.onabort = () => reject(new DOMException("cancelled", "AbortError"));
    signal?.addEventListener("abort", () => transfer.abort());
    const ask = (/** @type {Event} */ leaving) => leaving.preventDefault();
    window.addEventListener("beforeunload", ask);
    transfer.onloadend = () => window.removeEventListener("beforeunload", ask);
    transfer.send(file);
  });
}

/** Whether no answer came, so that it is worth asking again. @param {unknown} error */
export const isOffline = (error) => error instanceof ApiError && error.kind === "offline";

/** Resolves when a server that did not answer is worth asking again. @returns {Promise<void>} */
export const untilNextTry = () => new Promise((resolve) => setTimeout(resolve, TRIES_AGAIN_MS));

/** Whether what was asked for does not exist. @param {unknown} error */
export const isMissing = (error) => error instanceof ApiError && error.status === 404;

/** Whether another tab was faster. @param {unknown} error */
export const isConflict = (error) => error instanceof ApiError && error.status === 409;

/** Whether an error only says that we ourselves cancelled. @param {unknown} error */
export const isAbort = (error) => error instanceof DOMException && error.name === "AbortError";

/** A sentence for a person. @param {unknown} error */
export const sentence = (error) => told(error instanceof Error ? error.message : String(error)).words;
