/** Reading without workers: for tests in node, which has the same `fetch`. */
import { registerCodecs } from "./codecs";
import type { Answer } from "./messages";
import type { Port } from "./reader_pool";
import { answerTo } from "./worker";

export { Library, openStores } from "./open";

/** A port that answers in this thread. */
export function inProcessPort(): Port {
  registerCodecs();
  let listen: (answer: Answer) => void = () => undefined;
  return {
    postMessage: (asked) => void answerTo(asked).then(({ answer }) => listen(answer)),
    onanswer: (listener) => {
      listen = listener;
    },
  };
}
