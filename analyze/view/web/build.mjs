// Builds the page: `node build.mjs [FOLDER]` writes index.html, main.js, main.css, licenses.txt and build.json into FOLDER
// (default: ../bundle). The same sources give the same bytes.
import { createHash } from "node:crypto";
import { mkdir, readdir, readFile, rm, writeFile } from "node:fs/promises";
import { dirname, join, relative, resolve, sep } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const HERE = dirname(fileURLToPath(import.meta.url));
const sha256 = (bytes) => createHash("sha256").update(bytes).digest("hex");

/** One digest of everything that the bundle depends on: of lines "sha256  path", in the order of the paths. */
async function digestOfSources() {
  const entries = await readdir(HERE, { recursive: true, withFileTypes: true });
  const files = entries.filter((entry) => entry.isFile()).map((entry) => join(entry.parentPath ?? entry.path, entry.name));
  const paths = files.map((file) => relative(HERE, file).split(sep).join("/")).filter((path) => !path.startsWith("node_modules/"));
  const lines = paths.sort().map(async (path) => `${sha256(await readFile(join(HERE, path)))}  ${path}\n`);
  return sha256((await Promise.all(lines)).join(""));
}

/** The licences of the packages that are part of the page. */
async function licenses(inputs) {
  const names = new Set(Object.keys(inputs).flatMap((path) => path.match(/.*node_modules\/((?:@[^/]+\/)?[^/]+)\//)?.[1] ?? []));
  const parts = [];
  for (const name of [...names].sort()) {
    const folder = join(HERE, "node_modules", name);
    const { version, license } = JSON.parse(await readFile(join(folder, "package.json"), "utf8"));
    const text = (await readdir(folder)).find((file) => /^licen[sc]e/i.test(file));
    parts.push(`${name} ${version}\n\n${(text ? await readFile(join(folder, text), "utf8") : `License: ${license}`).trim()}\n`);
  }
  return parts.join(`\n${"-".repeat(80)}\n\n`);
}

const folder = process.argv[2] ? resolve(process.argv[2]) : join(HERE, "../bundle");
const { outputFiles, metafile } = await build({
  absWorkingDir: HERE,
  entryPoints: { main: "src/main.tsx" },
  outdir: "out",
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  charset: "utf8",
  legalComments: "none",
  jsx: "automatic",
  jsxImportSource: "preact",
  platform: "browser",
  metafile: true,
  write: false,
  logLevel: "warning",
});
const files = new Map(outputFiles.map((file) => [file.path.split(sep).at(-1), Buffer.from(file.contents)]));
files.set("index.html", await readFile(join(HERE, "src/index.html")));
files.set("licenses.txt", Buffer.from(await licenses(metafile.inputs)));
const digests = Object.fromEntries([...files.keys()].sort().map((name) => [name, sha256(files.get(name))]));
files.set("build.json", Buffer.from(`${JSON.stringify({ sources: await digestOfSources(), files: digests }, null, 2)}\n`));
await mkdir(folder, { recursive: true });
for (const old of await readdir(folder)) if (!files.has(old)) await rm(join(folder, old));
for (const [name, bytes] of files) await writeFile(join(folder, name), bytes);
