/** Groupings as TOML: what `--grouping FILE` takes, read with the same checks, and written. */
import { parse, TomlDate, TomlError } from "smol-toml";
import { conventionalRatio, type Grouping, makeGrouping, type Ratio } from "./grouping";
import {
  BadArgument,
  characters,
  didYouMean,
  GroupingError,
  length,
  listing,
  shortened,
  thousands,
  UserError,
  visible,
} from "./text";

const LINE_CHARACTERS = 4096;
const FILE_BYTES = 4_000_000;
const FIELDS = ["groups", "name", "description", "ratio", "overlap", "allow_empty"];
const RATIO_FIELDS = ["numerator", "denominator"];

type Table = Record<string, unknown>;

/** A value that does not have the declared type; `at` is its path in the document. */
class Misfit extends UserError {
  constructor(at: string, problem: string) {
    super(`${at} ${problem}`);
  }
}

/** Read a TOML grouping; every error names the file. `path` is what the file is called in errors. */
export function readGroupingFile(text: string, path: string): Grouping {
  const bytes = new TextEncoder().encode(text).length;
  if (bytes > FILE_BYTES) {
    throw new GroupingError(
      `Cannot read grouping file ${path}: it has ${thousands(bytes)} bytes; expected at most ${thousands(FILE_BYTES)}.`,
    );
  }
  let document: Table;
  try {
    document = parse(text, { integersAsBigInt: true });
  } catch (error) {
    if (!(error instanceof TomlError)) throw error;
    const [problem] = error.message.replace(/^Invalid TOML document: /, "").split("\n");
    throw new GroupingError(
      `Grouping file ${path} is not valid TOML: ${problem} (at line ${error.line}, column ${error.column}).`,
    );
  }
  try {
    return groupingOf(document, stem(path));
  } catch (error) {
    if (error instanceof UserError) throw new GroupingError(`Grouping file ${path}: ${error.message}`);
    throw error;
  }
}

function groupingOf(document: Table, fileName: string): Grouping {
  const groups = new Map<string, string[]>();
  let given: Partial<Omit<Grouping, "groups">> & { ratio?: Ratio } = {};
  for (const [field, value] of Object.entries(document)) {
    if (!FIELDS.includes(field)) throw unknownField("$", field, FIELDS);
    const at = `$.${field}`;
    if (field === "groups") {
      for (const [name, selectors] of Object.entries(expected(value, "dict", at) as Table)) {
        const own = `${at}.${shortened(name)}`;
        groups.set(name, typeof selectors === "string" ? [selectors] : texts(selectors, own));
      }
    } else if (field === "ratio") given = { ...given, ratio: ratioOf(value, at) };
    else if (field === "overlap") given = { ...given, overlap: expected(value, "bool", at) as boolean };
    else if (field === "allow_empty") given = { ...given, allowEmpty: texts(value, at) };
    else given = { ...given, [field]: expected(value, "str", at) as string };
  }
  if (!("groups" in document)) throw new Misfit("$", "lacks the field 'groups'.");
  const name = given.name || fileName;
  checkText("grouping's name", name);
  return makeGrouping({ ...given, name, groups, ratio: given.ratio ?? conventionalRatio(groups.keys()) });
}

function ratioOf(value: unknown, at: string): Ratio {
  const sides: Record<string, string[]> = {};
  for (const [side, names] of Object.entries(expected(value, "dict", at) as Table)) {
    if (!RATIO_FIELDS.includes(side)) throw unknownField(at, side, RATIO_FIELDS);
    sides[side] = texts(names, `${at}.${side}`);
  }
  const missing = RATIO_FIELDS.find((side) => !(side in sides));
  if (missing) throw new Misfit(at, `lacks the field '${missing}'.`);
  return { numerator: sides.numerator!, denominator: sides.denominator! };
}

function texts(value: unknown, at: string): string[] {
  return (expected(value, "list", at) as unknown[]).map((item, i) => expected(item, "str", `${at}[${i}]`) as string);
}

function expected(value: unknown, kind: string, at: string): unknown {
  if (kindOf(value) !== kind) throw new Misfit(at, `is ${kindOf(value)}; expected ${kind}.`);
  return value;
}

/** The name of a value's type in Python, which the sentences have. */
function kindOf(value: unknown): string {
  if (typeof value === "string") return "str";
  if (typeof value === "boolean") return "bool";
  if (typeof value === "bigint") return "int";
  if (typeof value === "number") return "float";
  if (Array.isArray(value)) return "list";
  if (value instanceof TomlDate) return value.isDateTime() ? "datetime" : value.isDate() ? "date" : "time";
  return "dict";
}

function unknownField(at: string, field: string, fields: readonly string[]): Misfit {
  const near = didYouMean(field, fields);
  return new Misfit(at, `has an unknown field '${shortened(field)}'.${near} Existing: ${listing(fields)}.`);
}

function checkText(what: string, text: string): void {
  if (length(text) > LINE_CHARACTERS) {
    throw new BadArgument(
      `The length of the ${what} '${visible(shortened(text, 60))}' is ${thousands(length(text))}; expected 0 to ` +
        `${thousands(LINE_CHARACTERS)}.`,
    );
  }
  if (visible(text) !== text) {
    throw new BadArgument(
      `The ${what} '${visible(shortened(text))}' has control characters: expected printable text.`,
    );
  }
}

/** The last part of a path without its ending, as Python's `Path.stem`. */
function stem(path: string): string {
  const last = path.split("/").filter((part) => part).at(-1) ?? "";
  const dot = last.lastIndexOf(".");
  return dot > 0 && dot < last.length - 1 ? last.slice(0, dot) : last;
}

/** A grouping as the text of a TOML file, which `readGroupingFile` and `vla-analyze --grouping FILE` read. */
export function writeGroupingFile(grouping: Grouping): string {
  const lines = [`name = ${tomlText(grouping.name)}`];
  if (grouping.description) lines.push(`description = ${tomlText(grouping.description)}`);
  if (grouping.overlap) lines.push("overlap = true");
  if (grouping.allowEmpty.length) lines.push(`allow_empty = ${tomlList(grouping.allowEmpty)}`);
  lines.push("", "[groups]");
  for (const [name, selectors] of grouping.groups) {
    lines.push(`${tomlKey(name)} = ${selectors.length === 1 ? tomlText(selectors[0]!) : tomlList(selectors)}`);
  }
  if (grouping.ratio) {
    lines.push("", "[ratio]");
    lines.push(`numerator = ${tomlList(grouping.ratio.numerator)}`);
    lines.push(`denominator = ${tomlList(grouping.ratio.denominator)}`);
  }
  return `${lines.join("\n")}\n`;
}

function tomlKey(name: string): string {
  return /^[A-Za-z0-9_-]+$/.test(name) ? name : tomlText(name);
}

function tomlList(values: readonly string[]): string {
  return `[${values.map(tomlText).join(", ")}]`;
}

function tomlText(text: string): string {
  const inner = characters(text).map((character) => {
    if (character === '"' || character === "\\") return `\\${character}`;
    if (visible(character) === character) return character;
    return `\\U${character.codePointAt(0)!.toString(16).padStart(8, "0")}`;
  });
  return `"${inner.join("")}"`;
}
