// Builds the viewer's page: `node build.mjs [FOLDER]` writes index.html, viewer.js, viewer.css, licenses.txt and
// build.json into FOLDER (default: ../bundle). The same sources give the same bytes.
//
// `node build.mjs --module src/NAME.ts FILE.mjs` builds one module for node, with everything that it imports; tests
// of the arithmetic do that.
import { createHash } from "node:crypto";
import { mkdir, readFile, readdir, rm, writeFile } from "node:fs/promises";
import { dirname, join, relative, resolve, sep } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const HERE = dirname(fileURLToPath(import.meta.url));

// Stores use blosc only (docs/store.md). zarrita knows other compressors; each would bring its own WebAssembly.
const ABSENT_CODECS = /^numcodecs\/(zstd|lz4|gzip|zlib)$/;
const onlyBlosc = {
  name: "only-blosc",
  setup(bundler) {
    bundler.onResolve({ filter: ABSENT_CODECS }, (found) => ({ path: found.path, namespace: "absent" }));
    bundler.onLoad({ filter: /./, namespace: "absent" }, (found) => ({
      contents: `export default { fromConfig() { throw new Error("This page does not read ${found.path}."); } };`,
    }));
  },
};

// The glue of blosc's WebAssembly makes a function from text, which the page's content security policy forbids
// ('unsafe-eval' would allow it to everything). This makes the same function as a closure.
const MADE_FROM_TEXT = "g = La(Ka).apply(null, r);";
const MADE_AS_CLOSURE = `g = ((fail, invoke, wasm, runDestructors, result, _, ...types) => function (...given) {
            if (given.length !== w - 2) fail("function " + p + " called with " + given.length + " arguments");
            const destructors = [];
            const wired = given.map((value, i) => types[i].toWireType(destructors, value));
            const returned = invoke(wasm, ...wired);
            runDestructors(destructors);
            return result.fromWireType(returned);
          })(...r);`;
const withoutEval = {
  name: "without-eval",
  setup(bundler) {
    bundler.onLoad({ filter: /numcodecs[\\/]dist[\\/]blosc\.js$/ }, async (found) => {
      const source = await readFile(found.path, "utf8");
      if (source.split(MADE_FROM_TEXT).length !== 2) throw new Error("numcodecs' blosc.js is another than build.mjs knows.");
      return { contents: source.replace(MADE_FROM_TEXT, () => MADE_AS_CLOSURE), loader: "js" };
    });
  },
};

const COMMON = {
  absWorkingDir: HERE,
  bundle: true,
  format: "esm",
  target: "es2022",
  charset: "utf8",
  legalComments: "none",
  loader: { ".txt": "text" },
  plugins: [onlyBlosc, withoutEval],
  logLevel: "warning",
};

/** Every file below `folder` but node_modules, as sorted paths with "/". */
async function filesOf(folder) {
  const entries = await readdir(folder, { recursive: true, withFileTypes: true });
  return entries
    .filter((entry) => entry.isFile())
    .map((entry) => relative(folder, join(entry.parentPath ?? entry.path, entry.name)).split(sep).join("/"))
    .filter((path) => !path.startsWith("node_modules/"))
    .sort();
}

const sha256 = (bytes) => createHash("sha256").update(bytes).digest("hex");

/** One digest of everything that the bundle depends on: of lines "sha256  path", in the order of the paths. */
async function digestOfSources() {
  const lines = [];
  for (const path of await filesOf(HERE)) lines.push(`${sha256(await readFile(join(HERE, path)))}  ${path}\n`);
  return sha256(lines.join(""));
}

/** Digests of what the page takes from elsewhere in the checkout, by the path as seen from here. */
async function filesFromElsewhere(inputs) {
  const paths = Object.keys(inputs).filter((path) => path.startsWith("../") && !path.includes("node_modules/"));
  return Object.fromEntries(
    await Promise.all(paths.sort().map(async (path) => [path, sha256(await readFile(join(HERE, path)))])),
  );
}

/** The licences of the packages that are part of the page. */
async function licenses(inputs) {
  const names = new Set();
  for (const path of Object.keys(inputs)) {
    const found = path.match(/.*node_modules\/((?:@[^/]+\/)?[^/]+)\//);
    if (found) names.add(found[1]);
  }
  const parts = [];
  for (const name of [...names].sort()) {
    const folder = join(HERE, "node_modules", name);
    const { version, license } = JSON.parse(await readFile(join(folder, "package.json"), "utf8"));
    const text = (await readdir(folder)).find((file) => /^licen[sc]e/i.test(file));
    const words = text ? await readFile(join(folder, text), "utf8") : `License: ${license}\n`;
    parts.push(`${name} ${version}\n\n${words.trim()}\n`);
  }
  return parts.join(`\n${"-".repeat(80)}\n\n`);
}

async function buildPage(folder) {
  const { outputFiles, metafile } = await build({
    ...COMMON,
    entryPoints: { viewer: "src/main.ts" },
    outdir: "out",
    minify: true,
    platform: "browser",
    metafile: true,
    write: false,
  });
  const files = new Map(outputFiles.map((file) => [file.path.split(sep).at(-1), Buffer.from(file.contents)]));
  files.set("index.html", await readFile(join(HERE, "src/index.html")));
  files.set("licenses.txt", Buffer.from(await licenses(metafile.inputs)));
  const digests = Object.fromEntries([...files.keys()].sort().map((name) => [name, sha256(files.get(name))]));
  const elsewhere = await filesFromElsewhere(metafile.inputs);
  const built = { sources: await digestOfSources(), elsewhere, files: digests };
  files.set("build.json", Buffer.from(`${JSON.stringify(built, null, 2)}\n`));

  await mkdir(folder, { recursive: true });
  for (const old of await readdir(folder)) if (!files.has(old)) await rm(join(folder, old));
  for (const [name, bytes] of files) await writeFile(join(folder, name), bytes);
}

async function buildModule(source, target) {
  await build({ ...COMMON, entryPoints: [source], outfile: resolve(target), platform: "node" });
}

const [first, ...others] = process.argv.slice(2);
if (first === "--module") await buildModule(others[0], others[1]);
else await buildPage(first ? resolve(first) : join(HERE, "../bundle"));
