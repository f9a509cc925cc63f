/** The pictures of a replan. Attention is lines around patches: the picture itself stays as it was. */
import { computed, signal } from "@preact/signals";

import { useLayoutEffect, useState } from "preact/hooks";

import { address, type CameraLayout, readPicture } from "./answers";
import { Hint } from "./hint";
import {
  about,
  cellsOf,
  covered,
  evenOf,
  groupOf,
  hasCells,
  layout,
  main,
  massesAt,
  massesOf,
  numReplans,
  OTHER_SITE,
  part,
  picked,
  type Scene,
  setPart,
  sides,
  toggled,
  uniformAt,
} from "./state";
import { cellLifts, cellSums, outline, percent, scaleEnd, shown } from "./sums";

/** Lines stand at this many times what even attention gives; the second is the highest that the maps reach. */
const FIRST = 2;
const SECOND = [50, 20, 10, 5];

/** The cell under the pointer. */
const pointed = signal<{ scene: Scene; camera: string; cell: number } | null>(null);

/** Of both lines, over the whole episode so that they mean the same at every call, and in `vla-attention overlay`. */
export const levels = computed<readonly number[]>(() => {
  const lifts: number[] = [];
  for (let at = 0; at < numReplans.value; at++) {
    const [mass, even] = [massesAt(at), uniformAt(at)];
    if (mass && even) for (const camera of Object.values(layout.value?.cameras ?? {})) lifts.push(...cellLifts(mass, even, camera));
  }
  const second = SECOND.find((level) => level <= 0.8 * scaleEnd(lifts));
  return second === undefined ? [FIRST] : [FIRST, second];
});

export interface At {
  readonly scene: Scene;
  readonly camera: string;
  readonly how: CameraLayout;
  readonly at: number;
}

/** How lines are drawn, one over the other: [colour, width in pixels, dashes]. A saved picture has no style sheet. */
export const STROKES = {
  first: [
    ["#000", 3.4, ""],
    ["#fff", 1.4, ""],
  ],
  second: [
    ["#000", 5, ""],
    ["#f0e442", 2.6, ""],
  ],
  named: [["#00c08b", 2.4, "5 4"]],
  touched: [["#ff6a1f", 2.4, "5 4"]],
  picked: [["#56b4e9", 3, ""]],
  moves: [
    ["#fff", 4, ""],
    ["#0072b2", 2, ""],
  ],
  most: [
    ["#fff", 6, ""],
    ["#0072b2", 3.8, ""],
  ],
  exact: [
    ["#fff", 6, ""],
    ["#0072b2", 4, ""],
  ],
} as const;
export type Kind = keyof typeof STROKES;
/** Lines without a length are squares. */
export const capOf = (kind: Kind): "square" | "butt" => (kind === "exact" ? "square" : "butt");

const LINES = { read: "what is read", moves: "what moves the action", both: "both" } as const;

/** Whether an episode's lines are drawn: around what is read, or around what moves the action, where there is a map. */
export const isDrawn = (scene: Scene, what: "read" | "moves"): boolean =>
  scene.layout.value?.moves ? ![what === "read" ? "moves" : "read"].includes(part("lines")) : what === "read";

/** A map of what moves the action, with the levels of its lines; null where the call has none, or none is drawn. */
function movesAt(scene: Scene, camera: string, at: number) {
  const [known, row] = [scene.moves.value.value, scene.moves.value.value?.replans.indexOf(at) ?? -1];
  const own = known?.cameras[camera];
  if (!own || row < 0 || !isDrawn(scene, "moves")) return null;
  const { levels } = main.moves.value.value ?? known;
  return { lift: own.lift[row]!, exact: own.exact[row]!, marked: known.marked, levels };
}

function meaningsOfMoves(): { moves: string; most: string; exact: string } {
  const known = isDrawn(main, "moves") ? main.moves.value.value : null;
  const [least, most] = known?.levels ?? [];
  return {
    moves: least ? `moves the action: ${least} times the mean patch` : "",
    most: most ? `${most} times` : "",
    exact: known?.marked ? "exact call without it" : "",
  };
}

/** What a kind of lines says; empty where none of it can be there. */
export const meaning = (kind: Kind): string =>
  ({
    first: isDrawn(main, "read") ? `${FIRST} times an even spread` : "",
    second: isDrawn(main, "read") && levels.value[1] ? `${levels.value[1]} times` : "",
    named: about.value.value?.objects.length && covered.value.value ? "named in the sentence" : "",
    touched: about.value.value?.objects.length && covered.value.value ? "touched" : "",
    picked: "",
    ...meaningsOfMoves(),
  })[kind];

/** Lines of a picture: their kind, their path for cells of a size, and of an object its name. */
export interface Line {
  readonly kind: Kind;
  readonly path: (size?: readonly [number, number]) => string;
  readonly title: string;
}

export function linesOf({ scene, camera, how, at }: At): Line[] {
  const around = (kind: Kind, inside: (cell: number) => boolean, title = "", by = 0): Line => ({
    kind,
    path: (size) => outline(how, inside, size, by),
    title,
  });
  const [mass, even] = [massesOf(scene, at), evenOf(scene, at)];
  const lifts = mass && even && isDrawn(scene, "read") ? cellLifts(mass, even, how) : null;
  const moved = movesAt(scene, camera, at);
  const episode = scene.about.value.value;
  const touched = new Set(episode?.events.map(({ thing }) => thing));
  const things = (episode?.objects ?? [])
    .filter(({ named, name }) => named || touched.has(name))
    .flatMap(({ name, shown: title, named }) => {
      const cells = new Set(scene.covered.value.value?.[camera]?.[name]?.[at] ?? []);
      return cells.size ? [around(named ? "named" : "touched", (cell) => cells.has(cell), title)] : [];
    });
  const own = new Set(cellsOf(scene, camera));
  return [
    ...(lifts ? levels.value.map((level, i) => around(i ? "second" : "first", (cell) => lifts[cell]! >= level)) : []),
    // Within the patches, so that both lines are seen where they go around the same ones.
    ...(moved?.levels.map((level, i) => around(i ? "most" : "moves", (cell) => (moved.lift[cell] ?? 0) >= level, "", 0.12)) ?? []),
    ...things,
    ...(moved?.marked && moved.exact.length
      ? [
          {
            kind: "exact" as const,
            path: ([wide, high]: readonly [number, number] = [1, 1]) =>
              moved.exact.map(({ x, y }) => `M${x * how.columns * wide} ${y * how.rows * high}h0`).join(""),
            title: "",
          },
        ]
      : []),
    ...(own.size ? [around("picked", (cell) => own.has(cell))] : []),
  ];
}

export function Strokes({ kind, path, title }: { kind: Kind; path: string; title?: string }) {
  return (
    <g class={kind}>
      {STROKES[kind].map(([stroke, width, dash]) => (
        <path key={stroke} d={path} stroke={stroke} stroke-width={width} stroke-dasharray={dash} stroke-linecap={capOf(kind)}>
          {title ? <title>{title}</title> : null}
        </path>
      ))}
    </g>
  );
}

function Lines(one: At) {
  return (
    <>
      {linesOf(one).map(({ kind, path, title }, i) => (
        <Strokes key={i} kind={kind} path={path()} title={title} />
      ))}
    </>
  );
}

function cellAt(event: MouseEvent & { currentTarget: Element }, how: CameraLayout): number {
  const box = event.currentTarget.getBoundingClientRect();
  const column = Math.floor(((event.clientX - box.left) / box.width) * how.columns);
  const row = Math.floor(((event.clientY - box.top) / box.height) * how.rows);
  return Math.max(0, Math.min(how.rows - 1, row)) * how.columns + Math.max(0, Math.min(how.columns - 1, column));
}

/** What is said of a cell: its share of attention, its lift, the objects that cover it; and how it moves the action. */
function aboutCell({ scene, camera, how, at }: At, cell: number): string {
  const [mass, even] = [massesOf(scene, at), evenOf(scene, at)];
  if (!mass || !even) return "";
  const sums = cellSums(mass, how);
  const ofPicture = sums.reduce((a, b) => a + b, 0);
  const things = Object.entries(scene.covered.value.value?.[camera] ?? {})
    .filter(([, ofReplans]) => ofReplans[at]?.includes(cell))
    .map(([name]) => name.replaceAll("_", " "));
  const where = `row ${Math.floor(cell / how.columns)}, column ${cell % how.columns}`;
  const moved = movesAt(scene, camera, at);
  const exact = moved?.exact.find((one) => one.cell === cell);
  const moves = moved ? `; moves the action ${shown(moved.lift[cell])} times the mean patch` : "";
  const without = exact ? `, exact: without it ${exact.said}` : "";
  return `${where}: ${percent(sums[cell])} of all attention, ${percent(sums[cell]! / ofPicture)} of this picture's, ${shown(cellLifts(mass, even, how)[cell])} times even${things.length ? `, ${things.join(", ")}` : ""}${moves}${without}`;
}

/** What is said of a picture while none of its cells is pointed at. */
function noteOf({ scene, camera, how, at }: At): string {
  const isMissing = scene.moves.value.value && isDrawn(scene, "moves") && !movesAt(scene, camera, at);
  return `${isMissing ? " no map of what moves the action was made at this call" : ""}${how.note ? ` ${how.note}` : ""}`;
}

/** Pictures that were asked for and are not there. */
export const coming = signal(0);

/** The call whose picture is there, and the picture: lines change with it. The one of the next call is asked for, too. */
function usePicture({ scene, camera, how, at }: At): { readonly at: number; readonly url: string } {
  const wanted = (replan: number): string => address.picture(scene.run.value, scene.name.value, camera, replan);
  const [shown, setShown] = useState({ at, url: "", of: "" });
  const [of, last] = [`${scene.run.value} ${scene.name.value}`, (scene.about.value.value?.starts.length ?? 1) - 1];
  // While another episode comes, what is known is of the one before.
  const isOf = !scene.about.value.pending;
  useLayoutEffect(() => {
    if (!how.stored || !isOf) return;
    let live = true;
    const show = (url: string): void => {
      if (live) setShown({ at, url, of });
    };
    coming.value++;
    const read = readPicture(wanted(at)).then(show, () => show("")); // what is wrong is said where it is read
    void read.finally(() => coming.value--);
    if (at < last) readPicture(wanted(at + 1)).catch(() => undefined);
    return () => {
      live = false;
    };
  }, [at, of, how.stored, isOf]);
  return how.stored && shown.of === of ? shown : { at, url: "" };
}

/** One camera at a replan. Clicks pick patches, in both episodes the same ones. */
function Picture(given: At) {
  const { scene, camera, how } = given;
  const { at, url } = usePicture(given);
  const one = { ...given, at };
  const here = pointed.value?.camera === camera && pointed.value.scene === scene ? pointed.value.cell : null;
  const toggle = (cell: number): void => {
    if (hasCells(scene, camera))
      setPart({ group: groupOf({ cells: { ...picked.value.cells, [camera]: toggled(cellsOf(scene, camera), cell) } }) });
  };
  const byKey = (event: KeyboardEvent): void => {
    const step = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: -how.columns, ArrowDown: how.columns }[event.key];
    if (step !== undefined)
      pointed.value = { scene, camera, cell: here === null ? 0 : (here + step + how.rows * how.columns) % (how.rows * how.columns) };
    else if (event.key === "Enter" && here !== null) toggle(here);
    else return;
    event.preventDefault();
    event.stopPropagation();
  };
  return (
    <figure class="picture">
      <div class="stack" data-camera={camera}>
        {how.stored ? (
          <img src={url || undefined} alt={`${camera} at call ${at}`} width={how.width} height={how.height} />
        ) : (
          <div class="grey" />
        )}
        <svg
          viewBox={`0 0 ${how.columns} ${how.rows}`}
          preserveAspectRatio="none"
          role="img"
          tabindex={0}
          aria-label={`${camera}: arrow keys go from patch to patch, Enter picks one`}
          onKeyDown={(event) => byKey(event)}
          onMouseMove={(event) => (pointed.value = { scene, camera, cell: cellAt(event, how) })}
          onMouseLeave={() => (pointed.value = null)}
          onClick={(event) => toggle(cellAt(event, how))}
        >
          <Lines {...one} />
          {here === null ? null : <rect class="pointed" x={here % how.columns} y={Math.floor(here / how.columns)} width="1" height="1" />}
        </svg>
      </div>
      <figcaption>
        <b>{camera}</b>
        {how.mirrored || !how.upright ? (
          <Hint
            text={`The policy sees it ${[how.mirrored && "mirrored", !how.upright && "upside down"].filter(Boolean).join(" and ")}; here it is as a person sees the scene.`}
          />
        ) : null}
        {how.stored ? null : " no pictures were stored: attention alone"}
        <span class="soft">{here !== null ? ` ${aboutCell(one, here)}` : noteOf(one)}</span>
      </figcaption>
    </figure>
  );
}

/** All pictures of an episode at a replan. */
export function Pictures({ scene, at }: { scene: Scene; at: number }) {
  const cameras = Object.entries(scene.layout.value?.cameras ?? {});
  const episode = scene.about.value.value;
  if (!episode) return null;
  if (!cameras.length) {
    const other = Object.entries(episode.sites).find(([, { cameras: of }]) => Object.keys(of).length)?.[0];
    return (
      <p>
        The keys of this site are no patches of pictures.{" "}
        {other ? <button onClick={() => setPart({ ...OTHER_SITE, site: other })}>Show site {other}</button> : null}
      </p>
    );
  }
  return (
    <section
      class={`pictures of-${Math.min(cameras.length, 3)}`}
      aria-label={`Pictures of ${episode.name}${scene === main ? "" : " beside it"}`}
      aria-busy={scene.masses.value === null}
    >
      {cameras.map(([camera, how]) => (
        <Picture key={camera} scene={scene} camera={camera} how={how} at={at} />
      ))}
    </section>
  );
}

/** A piece of a kind of lines, from a place on. */
export const sampleOf = (kind: Kind, x = 2, y = 4): string => (kind === "exact" ? `M${x + 10} ${y}h0` : `M${x} ${y}h20`);

/** What lines go around, where there are maps of what moves the action. */
function ChooseLines() {
  if (!sides.value.some(({ scene }) => scene.layout.value?.moves)) return null;
  const known = sides.value.map(({ scene }) => scene.moves.value.value).find((one) => one);
  const squares = known?.marked ? " Squares: patches that were taken away by an exact call too." : "";
  return (
    <fieldset class="shades soft" aria-label="Lines">
      lines around{" "}
      {Object.entries(LINES).map(([name, title]) => (
        <button key={name} class="chip" aria-pressed={part("lines") === name} onClick={() => setPart({ lines: name })}>
          {title}
        </button>
      ))}
      <Hint
        text={`Read: attention, times an even spread. Moves the action: ${known?.how}, on a scale of its own (times the mean patch of the call).${squares} Point at a patch, and what that does is said below the picture.`}
      />
    </fieldset>
  );
}

export function Legend() {
  return (
    <>
      <ChooseLines />
      <p class="legend soft">
        {(Object.keys(STROKES) as Kind[]).filter(meaning).map((kind) => (
          <span key={kind}>
            <svg viewBox="0 0 24 8" class="sample" aria-hidden="true">
              <Strokes kind={kind} path={sampleOf(kind)} />
            </svg>
            {meaning(kind)}
          </span>
        ))}
      </p>
    </>
  );
}
