/** The page's entry: everything that it shows is below `page/`. */
import "./main.css";
import * as zarr from "zarrita";

const page = document.getElementById("page");
if (page) page.textContent = `zarrita knows ${zarr.registry.size} codecs.`;
