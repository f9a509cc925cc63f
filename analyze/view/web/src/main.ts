/** The page's entry. The workers run the same script: it has no document there. */
import "./main.css";
import { serveWorker } from "./store/worker";

/** For tests; see there. */
export * as engine from "./engine";

if (typeof document === "undefined") serveWorker();
