// Questions that are asked faster than they are answered (while dragging): one under way, only the newest waits. What
// a server did not answer is asked again, so that no answer to an older question stays on the page.

import { isOffline, untilNextTry } from "./api.js";

/**
 * @template Argument, Result
 * @param {(argument: Argument) => Promise<Result>} ask
 * @param {(result: Result, argument: Argument) => void} onAnswer
 * @param {(error: unknown) => void} onError
 * @returns {(argument: Argument) => void}
 */
export function latest(ask, onAnswer, onError) {
  let busy = false;
  /** @type {{argument: Argument} | null} */
  let waiting = null;
  const next = async (/** @type {Argument} */ argument) => {
    busy = true;
    try {
      const result = await ask(argument);
      if (waiting === null) onAnswer(result, argument);
    } catch (error) {
      if (isOffline(error)) {
        await untilNextTry();
        waiting ??= { argument };
      } else if (waiting === null) onError(error);
    }
    busy = false;
    const newest = waiting;
    waiting = null;
    if (newest !== null) void next(/** @type {{argument: Argument}} */ (newest).argument);
  };
  return (argument) => {
    if (busy) waiting = { argument };
    else void next(argument);
  };
}
