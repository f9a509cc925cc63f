/** The built-in groupings: functions of the names in the stores. schemas/groupings/builtin_groupings.py. */
import { numKeys } from "../store/documents";
import { type Grouping, makeGrouping, type Ratio } from "./grouping";
import { decimalDigits, didYouMean, GroupingError, listing } from "./text";
import { NO_COVERAGE, NO_WORDS, type Vocabulary } from "./tokens";

const PUBLISHED_TEXT_KEYS = "256";
const TEXT = "role:bos | role:template | role:instruction | role:text";
const TEXT_ROLES = ["bos", "template", "instruction", "text"];

type Groups = [string, string[]][];

/** Groups of all other keys, so that the masses of a grouping sum to the row sum. */
function others(vocabulary: Vocabulary): Groups {
  // Cosmos's padded text takes attention and adds nothing.
  const nothing: Groups = vocabulary.roles.includes("null") ? [["null", ["role:null"]]] : [];
  return [
    ["state", ["role:state | role:proprio"]],
    ["action", ["role:action"]],
    ...nothing,
    ["padding", ["role:padding"]],
    ["masked", ["role:masked_image"]],
    ["other", ["*"]],
  ];
}

/** The ratio to the linguistic group, at sites that have both kinds of keys (Cosmos: not at `self`). */
function overLinguistic(vocabulary: Vocabulary, numerator: string[]): Ratio | null {
  const both = vocabulary.roles.includes("image") && TEXT_ROLES.some((role) => vocabulary.roles.includes(role));
  return numerator.length && both ? { numerator, denominator: ["linguistic"] } : null;
}

function withOthers(name: string, vocabulary: Vocabulary, own: Groups, seen: string[], description: string): Grouping {
  // A camera or object may have the name of another group: as in Python's dictionary, the later one stays.
  const groups = new Map([...own, ...others(vocabulary)]);
  const allowEmpty = [...own.map(([group]) => group), ...others(vocabulary).map(([group]) => group)];
  return makeGrouping({ name, groups, ratio: overLinguistic(vocabulary, seen), allowEmpty, description });
}

function byDefault(vocabulary: Vocabulary): Grouping {
  return withOthers(
    "default",
    vocabulary,
    [
      ["visual", ["role:image"]],
      ["linguistic", [TEXT]],
    ],
    ["visual"],
    "visual = every valid image key; linguistic = every valid text key that is not a state digit",
  );
}

function instruction(vocabulary: Vocabulary): Grouping {
  if (vocabulary.roles.includes("text") && !vocabulary.roles.includes("instruction")) {
    throw new GroupingError(`Grouping 'instruction': ${NO_WORDS}.`);
  }
  return withOthers(
    "instruction",
    vocabulary,
    [
      ["visual", ["role:image"]],
      ["linguistic", ["role:instruction"]],
      ["template", ["role:bos | role:template | role:text"]],
    ],
    ["visual"],
    "visual = every valid image key; linguistic = the words of the instruction only",
  );
}

function cameras(vocabulary: Vocabulary): Grouping {
  const views: Groups = vocabulary.cameras.map((camera) => [camera, [`camera:${camera} & role:image`]]);
  return withOthers(
    "cameras",
    vocabulary,
    [...views, ["linguistic", [TEXT]]],
    [...vocabulary.cameras],
    "one group per camera; linguistic as in 'default'",
  );
}

function objects(vocabulary: Vocabulary): Grouping {
  if (!vocabulary.objects.length) throw new GroupingError(`Grouping 'objects': ${NO_COVERAGE}.`);
  const things: Groups = vocabulary.objects.map((name) => [name, [`object:${name}`]]);
  return withOthers(
    "objects",
    vocabulary,
    [...things, ["linguistic", [TEXT]]],
    [...vocabulary.objects],
    "one group per scene object, weighted by the area of each patch that it covers; linguistic as in 'default'",
  );
}

/** The published scripts' key ranges on our rows. `textKeys`: decimal digits; null is their default, 256. */
function reference(vocabulary: Vocabulary, textKeys: string | null = null): Grouping {
  const name = textKeys === null ? "reference" : `reference-${textKeys}`;
  const spans = vocabulary.layout.spans;
  const ratio: Ratio = { numerator: ["visual"], denominator: ["linguistic"] };
  if (spans.some((span) => span.kind === "latent")) {
    if (textKeys !== null) {
      throw new GroupingError(
        `Cannot use the grouping 'reference:${textKeys}' here: a number of text keys belongs to the published ` +
          "pi scripts, and the Cosmos scripts compare latent frames; expected 'reference'.",
      );
    }
    const groups = new Map([
      ["visual", ["frame:curr_last"]],
      ["linguistic", ["frame:frame0"]],
    ]);
    const description = "the published Cosmos scripts' frames: 'linguistic' is a blank picture, and holds no language";
    return makeGrouping({ name, groups, ratio, description });
  }
  const [image, ...images] = spans.filter((span) => span.kind === "image");
  if (!image || !spans.some((span) => span.kind === "text")) {
    throw new GroupingError(
      "The grouping 'reference' is defined for the sites 'joint' (pi) and 'self' (Cosmos) only; choose with --site.",
    );
  }
  // As many keys as the first camera has, in all of its spans.
  const own = [image, ...images.filter((span) => span.camera !== null && span.camera === image.camera)];
  const first = own.reduce((sum, span) => sum + span.stop - span.start, 0);
  const wanted = textKeys ?? PUBLISHED_TEXT_KEYS;
  const last = Math.min(first + Number(wanted), numKeys(vocabulary.layout)) - 1;
  if (last < first) {
    throw new GroupingError(`Cannot use the grouping 'reference:${wanted}': expected at least one text key.`);
  }
  const cut = last - first + 1 < Number(wanted) ? ` (of ${wanted} keys; the site ends there)` : "";
  return makeGrouping({
    name,
    groups: new Map([
      ["visual", [`keys:0-${first - 1}`]],
      ["linguistic", [`keys:${first}-${last}`]],
      ["action", ["*"]],
    ]),
    ratio,
    allowEmpty: ["action"],
    description:
      `the published pi scripts' key ranges: 'linguistic' is keys ${first} to ${last}${cut}, ` +
      "wherever the prompt really is",
  });
}

const BUILTIN_GROUPINGS: Record<string, (vocabulary: Vocabulary) => Grouping> = {
  default: byDefault,
  instruction,
  cameras,
  objects,
  reference,
};
export const BUILTIN_NAMES = Object.keys(BUILTIN_GROUPINGS);

/** A built-in grouping by name (`reference:N`: `reference` with N text keys). */
export function findGrouping(name: string, vocabulary: Vocabulary): Grouping {
  const digits = name.startsWith("reference:") ? decimalDigits(name.slice("reference:".length)) : null;
  if (digits !== null) return reference(vocabulary, String(BigInt(digits)));
  if (BUILTIN_NAMES.includes(name)) return BUILTIN_GROUPINGS[name]!(vocabulary);
  if (name.startsWith("reference:")) {
    throw new GroupingError(
      `Unknown grouping '${name}'; expected 'reference:N' with a whole number N of text keys, or 'reference'.`,
    );
  }
  throw new GroupingError(
    `Unknown grouping '${name}'.${didYouMean(name, BUILTIN_NAMES)} Built in: ${listing(BUILTIN_NAMES)} ` +
      "(also reference:N); anything else is taken as a TOML file, and there is none of that name.",
  );
}
