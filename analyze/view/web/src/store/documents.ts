/**
 * The documents of a store as they are (docs/store.md): their types, and what is checked before anything believes them.
 *
 * Fields have the names that they have in the files. Characters are counted as code points, as Python does.
 */
import { type EffectsDocument, parseEffects } from "./effects_document";
import { type StepsDocument, parseSteps } from "./steps_document";
import { StoreError } from "./errors";
import { type Fields, finite, flag, list, name, object, oneOf, text, whole, wholes } from "./json_fields";
import * as limits from "./limits";

export const ROLES = {
  image: 1,
  masked_image: 2,
  bos: 3,
  template: 4,
  instruction: 5,
  state: 6,
  padding: 7,
  action: 8,
  proprio: 9,
  blank: 10,
  future: 11,
  value: 12,
  text: 13,
  null: 14,
  absent: 15,
  learned: 16,
} as const;
export type RoleName = keyof typeof ROLES;
const ROLE_NAMES = Object.keys(ROLES) as RoleName[];
/** Keys of these roles cannot hold information. */
export const INVALID_ROLES: readonly number[] = [ROLES.masked_image, ROLES.padding, ROLES.null, ROLES.absent];

const SPAN_KINDS = ["image", "text", "state", "action", "latent"] as const;

export interface GridDocument {
  rows: number;
  columns: number;
  image_height: number;
  image_width: number;
  /** Top, left, height and width of what it covers, in fractions of the whole picture. */
  part: readonly [number, number, number, number];
}

export function coversAll({ part }: GridDocument): boolean {
  return part[0] === 0 && part[1] === 0 && part[2] === 1 && part[3] === 1;
}

export interface SpanDocument {
  name: string;
  kind: (typeof SPAN_KINDS)[number];
  start: number;
  stop: number;
  camera: string | null;
  grid: GridDocument | null;
  growing: boolean;
  growing_offset: number;
}

export interface SiteDocument {
  name: string;
  spans: SpanDocument[];
  layers: number[];
  heads: number;
  num_action_queries: number;
}

export interface CameraDocument {
  name: string;
  source: string;
  upright: boolean;
  mirrored: boolean;
  visible: number;
}

export interface RootDocument {
  store_version: 1;
  policy: {
    name: string;
    family: string;
    checkpoint_format: string;
    untrained: boolean;
    num_layers: number;
    num_heads: number;
    num_denoise_steps: number;
    cameras: CameraDocument[];
  };
  protocol: { name: string; suite: string; wait_steps: number; replan_steps: number };
  recording: {
    layers: number[];
    denoise_steps: number[];
    heads: number[];
    queries: "mean" | "steps" | "all";
    num_action_queries: number;
    num_pools: number;
    mantissa_bits: number;
  };
  sites: SiteDocument[];
  /** What the run changed; its name is empty where nothing was changed. */
  interventions: { name: string };
  rerun_of: unknown;
}

export interface PieceDocument {
  key: number;
  text: string;
  start: number;
  stop: number;
}

export interface PromptDocument {
  text: string;
  pieces: PieceDocument[];
  instruction: [number, number];
}

export interface ObjectDocument {
  name: string;
  kind: "object" | "fixture" | "robot" | "background";
  of_interest: boolean;
}

export interface SegmentDocument {
  span: string;
  role: RoleName;
}

export interface EpisodeDocument {
  task_id: number;
  task_name: string;
  instruction: string;
  episode_index: number;
  success: boolean | null;
  num_steps: number;
  num_replans: number;
  prompts: PromptDocument[];
  segments: Record<string, SegmentDocument[]>;
  objects: ObjectDocument[];
  arrays: Record<string, { shape: number[] }>;
  env_step: number[];
  prompt_index: number[];
  denoise_time: number[];
  /** What was measured beside the calls; null: nothing. */
  effects: EffectsDocument | null;
  /** Where things were at every step, and whose goal was reached; null where no simulator told it. */
  steps: StepsDocument | null;
}

/** The axes of one site of an episode: the recorded numbers of its layers, denoise steps and heads. */
export interface AxesDocument {
  layer: number[];
  denoise: number[];
  head: number[];
}

/** The number of keys of a site. */
export function numKeys(site: SiteDocument): number {
  return site.spans.length ? site.spans[site.spans.length - 1]!.stop : 0;
}

function parseGrid(value: unknown, where: string): GridDocument | null {
  if (value === null || value === undefined) return null;
  const fields = object(value, where);
  const grid = {
    rows: whole(fields.rows, `${where}.rows`, limits.KEYS, 1),
    columns: whole(fields.columns, `${where}.columns`, limits.KEYS, 1),
    image_height: whole(fields.image_height, `${where}.image_height`, limits.PICTURE_SIDE, 1),
    image_width: whole(fields.image_width, `${where}.image_width`, limits.PICTURE_SIDE, 1),
    part: parsePart(fields.part, `${where}.part`),
  };
  whole(grid.image_height * grid.image_width, `the number of pixels of ${where}`, limits.PICTURE_PIXELS);
  if (!(grid.part[2] * grid.image_height >= 1 && grid.part[3] * grid.image_width >= 1)) {
    throw new StoreError(`The store cannot be shown: ${where} covers less than a pixel.`);
  }
  return grid;
}

function parsePart(value: unknown, where: string): GridDocument["part"] {
  if (value === undefined) return [0, 0, 1, 1];
  const [top, left, height, width, ...more] = list(value, where, 4).map((each, i) => finite(each, `${where}[${i}]`));
  const inside = Math.min(top!, left!) >= 0 && Math.max(top! + height!, left! + width!) <= 1 + 1e-9;
  if (!inside || width === undefined || more.length) throw new StoreError(`The store cannot be shown: ${where} is no part of a picture.`);
  return [top!, left!, height!, width];
}

function parseSite(value: unknown, where: string): SiteDocument {
  const fields = object(value, where);
  let position = 0;
  const seen = new Set<string>();
  const spans = list(fields.spans, `${where}.spans`, limits.SPANS).map((each, i): SpanDocument => {
    const at = `${where}.spans[${i}]`;
    const span = object(each, at);
    const start = whole(span.start, `${at}.start`, position, position);
    const stop = whole(span.stop, `${at}.stop`, limits.KEYS, position + 1);
    position = stop;
    const own = name(span.name, `${at}.name`);
    if (seen.has(own)) throw new StoreError(`The store cannot be shown: ${where} has two spans named "${own}".`);
    seen.add(own);
    const grid = parseGrid(span.grid, `${at}.grid`);
    if (grid && grid.rows * grid.columns !== stop - start) {
      throw new StoreError(`The store cannot be shown: the grid of ${at} covers another number of patches than its keys.`);
    }
    return {
      name: own,
      kind: oneOf(span.kind, `${at}.kind`, SPAN_KINDS),
      start,
      stop,
      camera: span.camera == null ? null : name(span.camera, `${at}.camera`),
      grid,
      growing: span.growing === undefined ? false : flag(span.growing, `${at}.growing`),
      growing_offset: span.growing_offset === undefined ? 0 : whole(span.growing_offset, `${at}.growing_offset`, limits.KEYS),
    };
  });
  const sizes = new Map<string, GridDocument>();
  for (const { camera, grid } of spans) {
    if (camera === null || !grid) continue;
    const first = sizes.get(camera) ?? grid;
    if (first.image_height !== grid.image_height || first.image_width !== grid.image_width) {
      throw new StoreError(`The store cannot be shown: the grids of camera "${camera}" are of pictures of different sizes.`);
    }
    sizes.set(camera, grid);
  }
  return {
    name: name(fields.name, `${where}.name`),
    spans,
    layers: wholes(fields.layers ?? [], `${where}.layers`, limits.AXIS, limits.AXIS),
    heads: whole(fields.heads ?? 0, `${where}.heads`, limits.AXIS),
    num_action_queries: whole(fields.num_action_queries ?? 0, `${where}.num_action_queries`, limits.QUERIES),
  };
}

function attributesOf(document: unknown, where: string): Fields {
  return object(object(document, where).attributes, `the attributes of ${where}`);
}

/** The root's attributes, from the document `zarr.json` of a store. */
export function parseRoot(document: unknown): RootDocument {
  const fields = attributesOf(document, "its zarr.json");
  if (fields.format !== "vla-attention") {
    throw new StoreError("This is no store of vla-capture: the format in its zarr.json is another one.");
  }
  const version = fields.store_version;
  if (version !== 1) {
    throw new StoreError(`The store has version ${JSON.stringify(version)?.slice(0, 20)} of the format; this page reads version 1.`);
  }
  const policy = object(fields.policy, "policy");
  const protocol = object(fields.protocol, "protocol");
  const recording = object(fields.recording, "recording");
  const axis = (of: string): number[] => wholes(recording[of], `recording.${of}`, limits.AXIS, limits.AXIS);
  const sites = list(fields.sites, "sites", limits.SITES).map((each, i) => parseSite(each, `sites[${i}]`));
  if (!sites.length) throw new StoreError("The store cannot be shown: it has no sites.");
  return {
    store_version: version,
    policy: {
      name: text(policy.name, "policy.name"),
      family: text(policy.family, "policy.family"),
      checkpoint_format: text(policy.checkpoint_format, "policy.checkpoint_format"),
      untrained: flag(policy.untrained, "policy.untrained"),
      num_layers: whole(policy.num_layers, "policy.num_layers", limits.AXIS),
      num_heads: whole(policy.num_heads, "policy.num_heads", limits.AXIS),
      num_denoise_steps: whole(policy.num_denoise_steps, "policy.num_denoise_steps", limits.AXIS),
      cameras: list(policy.cameras, "policy.cameras", limits.SPANS).map((each, i) => {
        const camera = object(each, `policy.cameras[${i}]`);
        return {
          name: name(camera.name, `policy.cameras[${i}].name`),
          source: name(camera.source, `policy.cameras[${i}].source`),
          upright: flag(camera.upright, `policy.cameras[${i}].upright`),
          mirrored: flag(camera.mirrored, `policy.cameras[${i}].mirrored`),
          visible: typeof camera.visible === "number" ? camera.visible : 1,
        };
      }),
    },
    protocol: {
      name: text(protocol.name, "protocol.name"),
      suite: name(protocol.suite, "protocol.suite"),
      wait_steps: whole(protocol.wait_steps, "protocol.wait_steps", limits.REPLANS),
      replan_steps: whole(protocol.replan_steps, "protocol.replan_steps", limits.REPLANS),
    },
    recording: {
      layers: axis("layers"),
      denoise_steps: axis("denoise_steps"),
      heads: axis("heads"),
      queries: oneOf(recording.queries, "recording.queries", ["mean", "steps", "all"]),
      num_action_queries: whole(recording.num_action_queries, "recording.num_action_queries", limits.QUERIES),
      num_pools: whole(recording.num_pools ?? 0, "recording.num_pools", limits.QUERIES),
      mantissa_bits: whole(recording.mantissa_bits, "recording.mantissa_bits", 23),
    },
    sites,
    interventions: { name: text(object(fields.interventions ?? {}, "interventions").name ?? "", "interventions.name") },
    rerun_of: fields.rerun_of ?? null,
  };
}

function parsePrompt(value: unknown, where: string): PromptDocument {
  const fields = object(value, where);
  const content = text(fields.text, `${where}.text`);
  const length = Array.from(content).length;
  const [first, last] = wholes(fields.instruction, `${where}.instruction`, 2, length);
  return {
    text: content,
    instruction: [first ?? 0, last ?? 0],
    pieces: list(fields.pieces, `${where}.pieces`, limits.TEXT_CHARACTERS).map((each, i) => {
      const piece = object(each, `${where}.pieces[${i}]`);
      return {
        key: whole(piece.key, `${where}.pieces[${i}].key`, limits.KEYS),
        text: text(piece.text, `${where}.pieces[${i}].text`),
        start: whole(piece.start, `${where}.pieces[${i}].start`, length),
        stop: whole(piece.stop, `${where}.pieces[${i}].stop`, length),
      };
    }),
  };
}

/** An episode's attributes, from the document `zarr.json` of its group. */
export function parseEpisode(document: unknown, name_: string): EpisodeDocument {
  const fields = attributesOf(document, `the zarr.json of ${name_}`);
  const replans = whole(fields.num_replans, "num_replans", limits.REPLANS, 1);
  const prompts = list(fields.prompts, "prompts", limits.LISTED).map((each, i) => parsePrompt(each, `prompts[${i}]`));
  const arrays: Record<string, { shape: number[] }> = Object.create(null) as Record<string, { shape: number[] }>;
  for (const [path, record] of Object.entries(object(fields.arrays, "arrays"))) {
    const shape = object(record, `arrays["${path}"]`).shape;
    arrays[path] = { shape: wholes(shape, `the shape of ${path}`, limits.ARRAY_AXES, 2 ** 40) };
  }
  const segments: Record<string, SegmentDocument[]> = Object.create(null) as Record<string, SegmentDocument[]>;
  for (const [site, each] of Object.entries(object(fields.segments, "segments"))) {
    segments[site] = list(each, `segments.${site}`, limits.LISTED).map((one, i) => {
      const segment = object(one, `segments.${site}[${i}]`);
      return {
        span: name(segment.span, `segments.${site}[${i}].span`),
        role: oneOf(segment.role, `segments.${site}[${i}].role`, ROLE_NAMES),
      };
    });
  }
  const numSteps = whole(fields.num_steps, "num_steps", 2 ** 40);
  const numbers = (of: string, most: number): number[] => {
    const found = wholes(fields[of] ?? [], of, limits.REPLANS, most);
    if (found.length && found.length !== replans) {
      throw new StoreError(`The store cannot be shown: ${of} has ${found.length} numbers for ${replans} replans.`);
    }
    return found;
  };
  return {
    task_id: whole(fields.task_id, "task_id", 1e12),
    task_name: name(fields.task_name, "task_name"),
    instruction: text(fields.instruction, "instruction"),
    episode_index: whole(fields.episode_index, "episode_index", 1e12),
    success: fields.success == null ? null : flag(fields.success, "success"),
    num_steps: numSteps,
    num_replans: replans,
    prompts,
    segments,
    objects: list(fields.objects, "objects", limits.LISTED).map((each, i) => {
      const thing = object(each, `objects[${i}]`);
      return {
        name: name(thing.name, `objects[${i}].name`),
        kind: oneOf(thing.kind, `objects[${i}].kind`, ["object", "fixture", "robot", "background"]),
        of_interest: flag(thing.of_interest, `objects[${i}].of_interest`),
      };
    }),
    arrays,
    env_step: numbers("env_step", 2 ** 40),
    prompt_index: prompts.length ? numbers("prompt_index", prompts.length - 1) : [],
    denoise_time: list(fields.denoise_time ?? [], "denoise_time", limits.AXIS).map(Number),
    effects: parseEffects(fields.effects, replans),
    steps: parseSteps(fields.steps, numSteps),
  };
}

/** The axes of a site, from the document `zarr.json` of its group. */
export function parseAxes(document: unknown, where: string): AxesDocument {
  const fields = attributesOf(document, where);
  const axis = (of: string): number[] => wholes(fields[of], `${of} of ${where}`, limits.AXIS, limits.AXIS);
  return { layer: axis("layer"), denoise: axis("denoise"), head: axis("head") };
}
