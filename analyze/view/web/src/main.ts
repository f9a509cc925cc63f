/** The page's entry. The workers run the same script: it has no document there. */
import "./main.css";
import { serveWorker } from "./store/worker";

if (typeof document === "undefined") serveWorker();
