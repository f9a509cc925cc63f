/** The page's entry. The workers run the same script: it has no document there. */
import "./main.css";
import { App } from "./page/app";
import { serveWorker } from "./store/worker";

/** For tests; see there. */
export * as engine from "./engine";
export * as reading from "./reading";

if (typeof document === "undefined") serveWorker();
else {
  const page = document.getElementById("page");
  if (page) new App(page);
}
