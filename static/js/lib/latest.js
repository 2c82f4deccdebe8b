// Questions that are asked faster than they are answered (while dragging): one under way, only the newest waits. What
// a server did not answer is asked again, so that no answer to an older question stays on the page.

import { isOffline, untilNextTry } from "./api.js";

/**
 * @template Argument, Result
 * @param {(argument: Argument) => Promise<Result>} ask
 * @param {(result: Result, argument: Argument) => void} onAnswer
 * @param {(error: unknown) => void} onError
 * @returns {(argument: Argument) => Promise<void>} resolves when the newest question is answered
 */
export function latest(ask, onAnswer, onError) {
  /** @type {Promise<void> | null} */
  let busy = null;
  /** @type {{argument: Argument} | null} */
  let waiting = null;
  const next = async (/** @type {Argument} */ argument) => {
    try {
      const result = await ask(argument);
      if (waiting === null) onAnswer(result, argument);
    } catch (error) {
      if (isOffline(error)) {
        await untilNextTry();
        waiting ??= { argument };
      } else if (waiting === null) onError(error);
    }
  };
  const askAll = async () => {
    await null; // so that `busy` is set before it can be over
    while (waiting !== null) {
      const { argument } = waiting;
      waiting = null;
      await next(argument);
    }
    busy = null;
  };
  return (argument) => {
    waiting = { argument };
    return (busy ??= askAll());
  };
}
