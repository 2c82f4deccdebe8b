// Questions that overtake each other: while one is on its way only the newest of the later ones is kept.

/**
 * @template Question, Answer
 * @param {(question: Question) => Promise<Answer>} ask
 * @param {(answer: Answer, question: Question) => void} onAnswer
 * @param {(error: unknown) => void} onError
 * @returns {(question: Question) => void}
 */
export function newestOnly(ask, onAnswer, onError) {
  let busy = false;
  /** @type {{question: Question} | null} */
  let waiting = null;
  return async (question) => {
    waiting = { question };
    if (busy) return;
    busy = true;
    while (waiting !== null) {
      const next = /** @type {{question: Question}} */ (waiting).question;
      waiting = null;
      try {
        const answer = await ask(next);
        if (waiting === null) onAnswer(answer, next);
      } catch (error) {
        if (waiting === null) onError(error);
      }
    }
    busy = false;
  };
}
