/** What the server answers (analyze/view/answers.py has the addresses), as types, and how it is asked. */
import { signal } from "@preact/signals";

export type Grid = (number | null)[][];
export type Outcome = boolean | null;

export interface EpisodeLine {
  readonly name: string;
  readonly task: number;
  readonly episode: number;
  /** Why the episode cannot be read; nothing else is known of it then. */
  readonly failed?: string;
  readonly instruction: string;
  readonly told: string;
  readonly told_other: boolean;
  readonly outcome: Outcome;
  readonly verdict: string;
  /** Whether it did or touched something else than it was told. */
  readonly did_other: boolean;
  /** In an exchange, the task in whose scene and initial state it began; null: its own. */
  readonly scene: number | null;
  readonly num_steps: number;
  readonly num_replans: number;
  /** Camera and replan. */
  readonly picture: readonly [string, number] | null;
}

export interface SiteAxes {
  readonly name: string;
  readonly keys: number;
  /** Whether it has patches of pictures, and text. */
  readonly pictured: boolean;
  readonly spelled: boolean;
  readonly layers: readonly number[];
  readonly heads: readonly number[];
  readonly denoise_steps: readonly number[];
}

export interface Run {
  readonly name: string;
  readonly path?: string;
  readonly policy: string;
  readonly suite: string;
  readonly untrained: boolean;
  readonly rerun: boolean;
  readonly changed: readonly string[];
  readonly notes?: readonly string[];
  readonly sites: readonly SiteAxes[];
  readonly episodes: readonly EpisodeLine[];
}

export interface Finding {
  readonly asks: string;
  readonly sentence: string;
  readonly limit: string;
}

export interface Runs {
  readonly runs: readonly Run[];
  /** Of a folder or file of answers: whether it has each head's rows. */
  readonly copy?: { readonly heads: boolean };
}

/** What is computed while the page is open. */
export interface RunNumbers {
  readonly complete: boolean;
  readonly ratio: string | null;
  readonly failed: string | null;
  readonly findings: readonly Finding[] | null;
  readonly leaves: Readonly<Record<string, number>> | null;
  /** By episode how far the action moves with other words, or without them; and what that is. */
  readonly effects: Readonly<Record<string, number | null>> | null;
  readonly effect: string | null;
  readonly episodes: readonly { name: string; ratio: number | null; lift: number | null }[];
}

export interface CameraLayout {
  readonly rows: number;
  readonly columns: number;
  readonly height: number;
  readonly width: number;
  /** A part of a key's mass, and the cell of the map that it is added to. */
  readonly keys: readonly number[];
  readonly cells: readonly number[];
  /** null: a cell is one key's. */
  readonly shares: readonly number[] | null;
  readonly upright: boolean;
  readonly mirrored: boolean;
  /** Whether pictures were stored. */
  readonly stored: boolean;
  readonly note: string;
}

export interface Word {
  readonly text: string;
  readonly keys: readonly number[];
}

export interface SiteLayout {
  readonly cameras: Readonly<Record<string, CameraLayout>>;
  readonly prompts: readonly { text: string; words: readonly Word[] }[];
  /** Whether there are maps of which patches move the action. */
  readonly moves: boolean;
  /** What heads may look at. */
  readonly targets: readonly { name: string; selector: string }[];
}

export interface EpisodeEvent {
  readonly step: number;
  readonly replan: number;
  readonly kind: "touch" | "goal" | "gripper" | "end" | "leaves";
  readonly text: string;
  /** The touched thing. */
  readonly thing: string;
}

export interface SceneObject {
  readonly name: string;
  readonly shown: string;
  readonly named: boolean;
}

export interface About extends EpisodeLine {
  readonly env_step: readonly number[];
  /** Executed steps before each replan. */
  readonly starts: readonly number[];
  readonly end: number;
  readonly prompt_index: readonly number[];
  readonly objects: readonly SceneObject[];
  readonly events: readonly EpisodeEvent[];
  readonly courses: {
    readonly places: Readonly<Record<string, Grid>>;
    readonly hand: string;
    readonly gap: readonly (number | null)[];
    readonly executed: Grid;
  } | null;
  /** (replan, step, dimension) */
  readonly actions: readonly Grid[] | null;
  readonly effects: boolean;
  readonly sites: Readonly<Record<string, SiteLayout>>;
}

/** Numbers of a grouping, (replan, layer); the last layer is the mean of all. */
export interface Groups {
  readonly layers: readonly string[];
  readonly sides: readonly [readonly string[], readonly string[]] | null;
  readonly ratio?: Grid;
  readonly uniform_ratio?: Grid;
  readonly ratio_lift?: Grid;
  readonly groups: Readonly<Record<string, { color: string; keys: Grid; mass: Grid; fraction: Grid; lift: Grid }>>;
}

/** (replan, layer, head) */
export interface HeadLifts {
  readonly layers: readonly number[];
  readonly heads: readonly number[];
  readonly mass: readonly Grid[];
  readonly lift: readonly Grid[];
}

/** Of some episodes of a run, those in which a selector has keys in sight: lift (replan, head), and that of the layer (replan). */
export interface HeadsOfRun {
  readonly heads: readonly number[];
  readonly episodes: readonly { name: string; lift: Grid; layer: readonly (number | null)[] }[];
  /** Those that cannot be read. */
  readonly failed: readonly string[];
  /** Where the next answer begins. */
  readonly next: number | null;
}

/** What every head of a layer looks at in one call, by camera: lift (head, cell), and the cells of the named objects. */
export type CallMaps = Readonly<Record<string, { rows: number; columns: number; stored: boolean; lift: Grid; named: readonly number[] }>>;

export interface Effect {
  readonly condition: string;
  readonly number: number;
  readonly kind: string;
  readonly item: string;
  readonly item_kind: string;
  /** What stands in its place. */
  readonly instead: string;
  /** How sentences call it. */
  readonly label: string;
  readonly selector: string | null;
  readonly reader: string | null;
  /** (part, replan), and means over the replans. */
  readonly effect: Grid;
  readonly mean: readonly (number | null)[];
  /** Another noise seed's effect, of the first part. */
  readonly noise: number | null;
  readonly lift: number | null;
}

/** What an effect is told by. */
export interface EffectPart {
  readonly name: string;
  readonly title: string;
  /** How a sentence has a number of it: "the hand ends {} cm elsewhere". */
  readonly said: string;
  /** Whether it is a share of the steps. */
  readonly share: boolean;
  /** What fills a word with colour; null: the largest of the episode. */
  readonly full: number | null;
}

export interface Effects {
  readonly parts: readonly EffectPart[];
  readonly items: readonly Effect[];
  readonly notes: readonly string[];
}

/** Which patches move the action, at some calls, on a scale of its own: lift (map row, cell), times the mean patch. What
 * single ones do was measured: their centres in parts of the picture, and the effect in words. Marked: whether by squares. */
export interface Moves {
  readonly replans: readonly number[];
  readonly levels: readonly number[];
  readonly how: string;
  readonly marked: boolean;
  readonly cameras: Readonly<
    Record<string, { lift: Grid; exact: readonly (readonly { x: number; y: number; cell: number; said: string }[])[] }>
  >;
}

/** Cells of the maps that an object covers: camera -> object -> replan -> cells. */
export type Covered = Readonly<Record<string, Readonly<Record<string, readonly (readonly number[])[]>>>>;

export interface NumberArray {
  readonly shape: readonly number[];
  readonly data: Float32Array;
}

/** A page that is one file has its answers in itself: address -> base64 of compressed bytes. */
const within: Record<string, string> | null = JSON.parse(document.getElementById("answers")?.textContent || "null");
/** A folder of plain files: its answers are compressed files, and it answers no questions. */
let isFolder = false;
export const NEEDS_SERVER = "This is a copy of the page: for that, open the store itself with vla-attention view.";

interface Kept {
  readonly answer: Promise<unknown>;
  bytes: number;
  /** What is done when it is kept no longer. */
  readonly forget: (() => void) | undefined;
}

/** By address what was asked for, the last used at the end, as long as all of it is below `MOST_BYTES`. */
const kept = new Map<string, Kept>();
export const MOST_BYTES = 64e6;
/** Numbers in a JSON document take about so many times the memory of their digits. */
const JSON_BYTES = 4;

async function unpacked(bytes: Uint8Array<ArrayBuffer>): Promise<ArrayBuffer> {
  if (bytes[0] !== 0x1f || bytes[1] !== 0x8b) return bytes.buffer; // a server may have unpacked it
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

function inside(address: string): Uint8Array<ArrayBuffer> {
  const text = within?.[address];
  if (text === undefined) throw new Error(NEEDS_SERVER);
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}

/** What keeps the page from answering anything: the server has ended, or its store is gone; as a sentence, or empty. */
export const trouble = signal("");
const GONE = 410;
/** Of which run it is, as its addresses begin; empty: of all. */
let troubled = "";

async function answerTo(address: string): Promise<Response> {
  const reply = await fetch(address).catch(() => null);
  if (reply?.status === GONE) {
    troubled = /^runs\/\d+\//.exec(address)?.[0] ?? "";
    trouble.value = await saidBy(reply, address);
    throw new Error(trouble.value);
  }
  if (!reply) {
    troubled = "";
    trouble.value = "Nobody answers: vla-attention view has ended. Start it again, and load this page anew.";
    throw new Error(isFolder ? `Nobody answers for ${address}.` : trouble.value);
  }
  if (address.startsWith(troubled)) trouble.value = "";
  return reply;
}

const saidBy = async (reply: Response, address: string): Promise<string> => {
  const said = (await reply.json().catch(() => null)) as { error?: string } | null;
  return said?.error ?? `The server says ${reply.status} of ${address}.`;
};

async function bytesOf(address: string): Promise<ArrayBuffer> {
  if (within) return unpacked(inside(address));
  if (isFolder && address.includes("?")) throw new Error(NEEDS_SERVER);
  const reply = await answerTo(isFolder && !address.endsWith(".png") ? `${address}.gz` : address);
  if (reply.ok) return unpacked(new Uint8Array(await reply.arrayBuffer()));
  throw new Error(isFolder ? NEEDS_SERVER : await saidBy(reply, address));
}

/** Asks for an address once while it is kept; an answer that says what is wrong is an `Error` with its sentence. */
function once<T>(address: string, read: (bytes: ArrayBuffer) => T, forget?: (value: T) => void, times = 1): Promise<T> {
  const known = kept.get(address);
  kept.delete(address);
  if (known) {
    kept.set(address, known);
    return known.answer as Promise<T>;
  }
  const answer = bytesOf(address).then((bytes) => {
    own.bytes = times * bytes.byteLength;
    forgetOldest();
    return read(bytes);
  });
  const own: Kept = { answer, bytes: 0, forget: forget && (() => void answer.then(forget)) };
  kept.set(address, own);
  answer.catch(() => kept.delete(address));
  return answer;
}

function forgetOldest(): void {
  let total = [...kept.values()].reduce((sum, { bytes }) => sum + bytes, 0);
  for (const [address, one] of kept) {
    if (total <= MOST_BYTES) return;
    total -= one.bytes;
    if (one.bytes) kept.delete(address); // one that is on its way stays
    if (one.bytes) one.forget?.();
  }
}

export function readJson<T>(address: string): Promise<T> {
  const read = (bytes: ArrayBuffer): T => {
    const document = JSON.parse(new TextDecoder().decode(bytes)) as T & { error?: string };
    if (document?.error !== undefined) throw new Error(document.error); // a copy has the sentences of errors, too
    return document;
  };
  return once(address, read, undefined, JSON_BYTES);
}

/** Asks anew each time. */
export function readJsonNow<T>(address: string): Promise<T> {
  kept.delete(address);
  return readJson<T>(address);
}

export function readArray(address: string): Promise<NumberArray> {
  return once(address, parseNpy);
}

/** A picture as an address that is there at once. */
export function readPicture(address: string): Promise<string> {
  return once(address, (bytes) => URL.createObjectURL(new Blob([bytes], { type: "image/png" })), URL.revokeObjectURL);
}

/** What the page can show. Of a folder it is the one file that is not compressed, and says so. */
export async function readRuns(): Promise<Runs> {
  const runs = within ? await readJson<Runs>("runs.json") : ((await (await answerTo("runs.json")).json()) as Runs);
  isFolder = runs.copy !== undefined && !within;
  return runs;
}

/** Where an `<img>` finds a picture. */
export function pictureAt(address: string): string {
  if (!within) return address;
  const known = pictures.get(address);
  if (known) return known;
  const made = within[address] === undefined ? "" : URL.createObjectURL(new Blob([inside(address)], { type: "image/png" }));
  pictures.set(address, made);
  return made;
}
const pictures = new Map<string, string>();

/** A `.npy` file of version 1, little-endian float32 in C order. */
export function parseNpy(bytes: ArrayBuffer): NumberArray {
  const view = new DataView(bytes);
  if (view.getUint8(0) !== 0x93) throw new Error((JSON.parse(new TextDecoder().decode(bytes)) as { error: string }).error);
  const length = view.getUint16(8, true);
  const header = new TextDecoder("latin1").decode(new Uint8Array(bytes, 10, length));
  const shape = /'shape': \(([^)]*)\)/.exec(header)?.[1];
  if (shape === undefined || !header.includes("'<f4'")) throw new Error("An array came in another format than this page reads.");
  const data = new Float32Array(bytes.slice(10 + length));
  return {
    shape: shape
      .split(",")
      .filter((part) => part.trim())
      .map(Number),
    data,
  };
}

export const address = {
  numbers: (run: number): string => `runs/${run}/numbers.json`,
  episode: (run: number, episode: string): string => `runs/${run}/${episode}`,
  picture: (run: number, episode: string, camera: string, replan: number): string =>
    `runs/${run}/${episode}/pictures/${encodeURIComponent(camera)}/${replan}.png`,
};
