/** Groupings: named sets of groups, each a union of selectors, and what makes one wrong. schemas/groupings/grouping.py. */
import { atomsOf, parseSelector } from "./selector_parser";
import {
  didYouMean,
  GroupingError,
  length,
  listing,
  SelectorError,
  shortened,
  thousands,
  trimmed,
  visible,
} from "./text";

/** The selector that, alone, means: whatever no other group of the grouping takes. */
export const REST = "*";
const RESERVED_NAMES = ["numerator", "denominator", "ratio"];
const GROUP_NAME = /^[A-Za-z0-9_][\p{L}\p{N}_.@-]*$/u;
const MOST_GROUPS = 1000;
const NAME_CHARACTERS = 255;

export interface Ratio {
  readonly numerator: readonly string[];
  readonly denominator: readonly string[];
}

export interface Grouping {
  readonly name: string;
  /** Group name to selectors (their union). The order matters for display and for the rest group. */
  readonly groups: ReadonlyMap<string, readonly string[]>;
  readonly ratio: Ratio | null;
  /** Whether a key may belong to more than one group. */
  readonly overlap: boolean;
  /** Groups that may have no keys. */
  readonly allowEmpty: readonly string[];
  readonly description: string;
}

/** A grouping, after all checks that need no layout. */
export function makeGrouping(given: Pick<Grouping, "name" | "groups"> & Partial<Grouping>): Grouping {
  const grouping: Grouping = { ratio: null, overlap: false, allowEmpty: [], description: "", ...given };
  const { name, groups, ratio } = grouping;
  if (!groups.size) throw new GroupingError(`Grouping '${name}' has no groups; expected at least one NAME = SELECTOR.`);
  if (groups.size > MOST_GROUPS) {
    throw new GroupingError(
      `Grouping '${name}' has ${groups.size} groups; expected at most ${thousands(MOST_GROUPS)}.`,
    );
  }
  for (const [group, selectors] of groups) checkGroup(name, group, selectors);
  const rest = [...groups].filter(([, selectors]) => isRest(selectors)).map(([group]) => group);
  if (rest.length > 1) {
    throw new GroupingError(`Groups ${listing(rest)} are all '*'; only one group can take the rest.`);
  }
  const parts = [...(ratio ? [...ratio.numerator, ...ratio.denominator] : []), ...grouping.allowEmpty];
  for (const part of parts) {
    if (!groups.has(part)) {
      throw new GroupingError(
        `Grouping '${name}' refers to group '${part}', which it does not define.` +
          `${didYouMean(part, groups.keys())} Defined: ${listing(groups.keys())}.`,
      );
    }
  }
  if (ratio && !(ratio.numerator.length && ratio.denominator.length)) {
    throw new GroupingError(`The ratio of grouping '${name}' needs a numerator and a denominator.`);
  }
  return grouping;
}

/** Whether a group takes what no other group takes. */
export function isRest(selectors: readonly string[]): boolean {
  return trimmed(selectors[0] ?? "") === REST;
}

function checkGroup(grouping: string, group: string, selectors: readonly string[]): void {
  if (RESERVED_NAMES.includes(group) || !GROUP_NAME.test(group) || length(group) > NAME_CHARACTERS) {
    throw new GroupingError(
      `'${visible(shortened(group))}' cannot name a group: expected letters, digits, '_', '.', '-', and ` +
        `none of ${listing(RESERVED_NAMES)}.`,
    );
  }
  if (!selectors.length) throw new GroupingError(`Group '${group}' of grouping '${grouping}' has no selector.`);
  for (const selector of selectors) {
    if (trimmed(selector) === REST && selectors.length > 1) {
      throw new GroupingError(`Group '${group}': '*' (the rest) cannot be joined with other selectors.`);
    }
    try {
      parseSelector(selector);
    } catch (error) {
      if (error instanceof SelectorError) throw new SelectorError(`Group '${group}': ${error.message}`);
      throw error;
    }
  }
}

/** visual / linguistic for a grouping that has groups of these names and no ratio of its own. */
export function conventionalRatio(groups: Iterable<string>): Ratio | null {
  const names = new Set(groups);
  return names.has("visual") && names.has("linguistic") ? { numerator: ["visual"], denominator: ["linguistic"] } : null;
}

/** Split `NAME=SELECTOR` as the command line does. */
export function parseGroupArgument(text: string): [string, string] {
  const at = text.indexOf("=");
  const [name, selector] = at < 0 ? [text, ""] : [text.slice(0, at), text.slice(at + 1)];
  if (at < 0 || !trimmed(name) || !trimmed(selector)) {
    throw new GroupingError(
      `Cannot read --group '${text}'; expected NAME=SELECTOR, for instance nouns='word:bowl'.`,
    );
  }
  return [trimmed(name), trimmed(selector)];
}

/** Read `A,B/C`: groups of the numerator and of the denominator. */
export function parseRatioArgument(text: string): Ratio {
  const at = text.indexOf("/");
  const sides = at < 0 ? [text, ""] : [text.slice(0, at), text.slice(at + 1)];
  const [numerator, denominator] = sides.map((side) => side.split(",").map(trimmed).filter((name) => name));
  if (at < 0 || !numerator!.length || !denominator!.length) {
    throw new GroupingError(`Cannot read --ratio '${text}'; expected GROUP[,GROUP]/GROUP[,GROUP].`);
  }
  return { numerator: numerator!, denominator: denominator! };
}

/**
 * Add groups to a grouping, or make one of them alone (then the rest is a group of its own), as `--group` does. A name
 * given twice is a union of its selectors; a name that the base grouping has is replaced.
 */
export function withGroups(base: Grouping | null, added: Iterable<readonly [string, string]>): Grouping {
  const selectors = new Map<string, string[]>();
  for (const [name, selector] of added) selectors.set(name, [...(selectors.get(name) ?? []), selector]);
  const names = [...selectors.keys()];
  if (base) {
    const kept = [...base.groups].filter(([name]) => !selectors.has(name));
    return makeGrouping({ ...base, name: `${base.name}+${names.join("+")}`, groups: new Map([...selectors, ...kept]) });
  }
  const name = names.join("+");
  const ratio = conventionalRatio(names);
  if (![...selectors.values()].some((value) => value.length === 1 && value[0] === REST) && !selectors.has("rest")) {
    return makeGrouping({ name, groups: new Map([...selectors, ["rest", [REST]]]), ratio, allowEmpty: ["rest"] });
  }
  return makeGrouping({ name, groups: selectors, ratio });
}

/** The kinds of parts that a grouping's selectors name. */
export function kindsOf(grouping: Grouping): Set<string> {
  const texts = [...grouping.groups.values()].flat();
  return new Set(texts.flatMap((text) => atomsOf(parseSelector(text)).map((atom) => atom.kind)));
}
