/** Fields of documents whose content nobody has checked: each function gives the value, or a sentence that names it. */
import { StoreError, visible } from "./errors";
import { NAME_CHARACTERS, NESTING, TEXT_CHARACTERS } from "./limits";

export type Fields = Readonly<Record<string, unknown>>;

function wrong(where: string, value: unknown, expected: string): never {
  const given = value === undefined ? "nothing" : visible(JSON.stringify(value) ?? String(value));
  throw new StoreError(`The store cannot be shown: ${where} is ${given}; expected ${expected}.`);
}

/** Parse a document; the depth of its brackets is asked first, because parsers recurse. */
export function parseDocument(bytes: Uint8Array, where: string): unknown {
  let depth = 0;
  let inText = false;
  for (let i = 0; i < bytes.length; i++) {
    const byte = bytes[i];
    if (inText) {
      if (byte === 0x5c) i++;
      else if (byte === 0x22) inText = false;
    } else if (byte === 0x22) inText = true;
    else if (byte === 0x5b || byte === 0x7b) {
      if (++depth > NESTING) throw new StoreError(`The store cannot be shown: ${where} nests more than ${NESTING} deep.`);
    } else if (byte === 0x5d || byte === 0x7d) depth--;
  }
  try {
    return JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(bytes));
  } catch (failure) {
    throw new StoreError(`The store cannot be shown: ${where} is no JSON (${(failure as Error).message}).`);
  }
}

export function object(value: unknown, where: string): Fields {
  if (typeof value !== "object" || value === null || Array.isArray(value)) wrong(where, value, "an object");
  return value as Fields;
}

export function list(value: unknown, where: string, most: number): readonly unknown[] {
  if (!Array.isArray(value)) wrong(where, value, "a list");
  if (value.length > most) {
    throw new StoreError(`The store cannot be shown: ${where} is a list of ${value.length}; expected at most ${most}.`);
  }
  return value;
}

export function whole(value: unknown, where: string, most: number, least = 0): number {
  if (typeof value !== "number" || !Number.isInteger(value) || value < least || value > most) {
    wrong(where, value, `a whole number from ${least} to ${most}`);
  }
  return value;
}

export function wholes(value: unknown, where: string, length: number, most: number, least = 0): number[] {
  return list(value, where, length).map((each, i) => whole(each, `${where}[${i}]`, most, least));
}

export function finite(value: unknown, where: string): number {
  if (typeof value !== "number" || !Number.isFinite(value)) wrong(where, value, "a number");
  return value;
}

export function flag(value: unknown, where: string): boolean {
  if (typeof value !== "boolean") wrong(where, value, "true or false");
  return value;
}

export function text(value: unknown, where: string, most = TEXT_CHARACTERS): string {
  if (typeof value !== "string" || value.length > most) wrong(where, value, `a text of at most ${most} characters`);
  return value;
}

/** A name that is one part of a path. */
export function name(value: unknown, where: string): string {
  const given = text(value, where, NAME_CHARACTERS);
  if (!given || given === "." || given === ".." || /[/\\\p{C}]/u.test(given)) wrong(where, value, "a name without / and \\");
  return given;
}

export function oneOf<T extends string>(value: unknown, where: string, choices: readonly T[]): T {
  if (!choices.includes(value as T)) wrong(where, value, choices.map((choice) => `"${choice}"`).join(", "));
  return value as T;
}
