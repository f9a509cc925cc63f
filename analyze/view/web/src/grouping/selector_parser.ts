/**
 * The grammar of selectors: from text to a small tree, as schemas/groupings/selector_parser.py.
 *
 *   selector   = term { ("|" | "-") term }          left to right
 *   term       = factor { "&" factor }              binds tighter than | and -
 *   factor     = "(" selector ")" | "*" | kind ":" argument
 */
import { didYouMean, length, listing, SelectorError, shortened, SPACE, trimmed, trimmedEnd } from "./text";

export interface Atom {
  readonly kind: string;
  readonly argument: string;
}
export interface Operation {
  readonly operator: "&" | "|" | "-";
  readonly left: Selector;
  readonly right: Selector;
}
export const EVERYTHING = "*";
export type Selector = Atom | Operation | typeof EVERYTHING;

export const KIND_NAMES = ["camera", "role", "span", "frame", "word", "words", "object", "patch", "keys"] as const;

const PARENTHESES = 100;
/** `s`: white space as Python takes it. */
const s = `[${SPACE}]`;
const BARE = `[^${SPACE}&|()\\[\\]"']+[^${SPACE}&|()\\[\\]"]*(?:\\[[^\\]]*\\])?`;
const ARGUMENT = [`"[^"]*"`, `'[^']*'`, BARE, ""].join("|");
const BEGINS_BARE = new RegExp(`^${BARE}`, "u");
const TOKEN = new RegExp(
  `${s}*(?:(?<open>\\()|(?<close>\\))|(?<and>&)|(?<or>\\|)|(?<minus>-(?=${s}|$))|(?<star>\\*)` +
    `|(?<kind>[A-Za-z_]+):(?<argument>${ARGUMENT}))`,
  "uy",
);
const LEADING_SPACE = new RegExp(`${s}*`, "uy");

type Word = "open" | "close" | "and" | "or" | "minus" | "star" | "atom" | "end";
interface Token {
  kind: Word;
  text: string;
  atom?: Atom;
  /** Place in UTF-16 units. */
  at: number;
}

export function isOperation(selector: Selector): selector is Operation {
  return typeof selector === "object" && "operator" in selector;
}

/** Parse one selector; throws `SelectorError` that quotes it and says what was expected where. */
export function parseSelector(text: string): Selector {
  return new Parser(text).parse();
}

/** The value of a selector from those of its parts, left to right. Long unions are deep trees: no recursion. */
export function folded<T>(
  selector: Selector,
  leaf: (part: Atom | typeof EVERYTHING) => T,
  join: (operator: Operation["operator"], left: T, right: T) => T,
): T {
  const pending: (Selector | { join: Operation["operator"] })[] = [selector];
  const values: T[] = [];
  while (pending.length) {
    const part = pending.pop()!;
    if (typeof part === "object" && "join" in part) {
      const right = values.pop()!;
      values.push(join(part.join, values.pop()!, right));
    } else if (isOperation(part)) {
      pending.push({ join: part.operator }, part.right, part.left);
    } else {
      values.push(leaf(part));
    }
  }
  return values.pop()!;
}

/** All `kind:argument` parts of a selector, left to right. */
export function atomsOf(selector: Selector): Atom[] {
  const atoms: Atom[] = [];
  folded<void>(
    selector,
    (part) => {
      if (part !== EVERYTHING) atoms.push(part);
    },
    () => undefined,
  );
  return atoms;
}

/** One text for each part, equal for equal parts. */
export function atomKey(atom: Atom): string {
  return `${atom.kind}:${atom.argument}`;
}

/** The text of a part, with quotes where its name needs them; null where no quotes can hold the name. */
export function atomText({ kind, argument }: Atom): string | null {
  // Compared in length: with an end in the expression, long texts would take time in their square.
  if (BEGINS_BARE.exec(argument)?.[0].length === argument.length) return `${kind}:${argument}`;
  if (!argument.includes('"')) return `${kind}:"${argument}"`;
  return argument.includes("'") ? null : `${kind}:'${argument}'`;
}

/** A selector as text that `parseSelector` reads as the same tree. */
export function selectorText(selector: Selector): string {
  const texts = folded<{ text: string; level: number }>(
    selector,
    (part) => ({ text: part === EVERYTHING ? part : atomText(part)!, level: 2 }),
    (operator, left, right) => {
      const level = operator === "&" ? 1 : 0;
      const inside = (part: { text: string; level: number }, least: number): string =>
        part.level < least ? `(${part.text})` : part.text;
      return { text: `${inside(left, level)} ${operator} ${inside(right, level + 1)}`, level };
    },
  );
  return texts.text;
}

function unquoted(argument: string): string {
  return argument.startsWith('"') || argument.startsWith("'") ? argument.slice(1, -1) : argument;
}

class Parser {
  private readonly tokens: Token[];
  private next = 0;
  private depth = 0;

  constructor(private readonly text: string) {
    this.tokens = this.tokenise();
  }

  parse(): Selector {
    const tree = this.selector();
    const token = this.peek();
    if (token.kind !== "end") throw this.fail(token.at, `expected '&', '|' or ' - ' before '${token.text}'`);
    return tree;
  }

  private fail(at: number, problem: string): SelectorError {
    const place = length(this.text.slice(0, at)) + 1;
    return new SelectorError(`Cannot read selector '${shortened(this.text)}' at character ${place}: ${problem}.`);
  }

  private tokenise(): Token[] {
    const tokens: Token[] = [];
    const end = trimmedEnd(this.text).length;
    let position = 0;
    while (position < end) {
      TOKEN.lastIndex = LEADING_SPACE.lastIndex = position;
      const match = TOKEN.exec(this.text);
      const at = position + (LEADING_SPACE.exec(this.text)?.[0].length ?? 0);
      if (!match) throw this.fail(at, `expected KIND:NAME, where KIND is one of ${listing(KIND_NAMES)}`);
      const groups = match.groups as Record<string, string | undefined>;
      if (groups.kind !== undefined) {
        const atom = { kind: groups.kind, argument: unquoted(groups.argument!) };
        this.checkAtom(atom, at);
        tokens.push({ kind: "atom", text: atomKey(atom), atom, at });
      } else {
        const kind = (["open", "close", "and", "or", "minus", "star"] as const).find((name) => groups[name])!;
        tokens.push({ kind, text: groups[kind]!, at });
      }
      position += match[0].length;
    }
    return tokens;
  }

  private checkAtom(atom: Atom, at: number): void {
    if (!(KIND_NAMES as readonly string[]).includes(atom.kind)) {
      const near = didYouMean(atom.kind, KIND_NAMES).toLowerCase();
      throw this.fail(at, `unknown kind '${shortened(atom.kind)}:';${near} existing kinds: ${listing(KIND_NAMES)}`);
    }
    if (!trimmed(atom.argument)) throw this.fail(at, `expected a name after '${atom.kind}:'`);
  }

  private peek(): Token {
    return this.tokens[this.next] ?? { kind: "end", text: "", at: this.text.length };
  }

  private selector(): Selector {
    let tree = this.term();
    for (let token = this.peek(); token.kind === "or" || token.kind === "minus"; token = this.peek()) {
      this.next++;
      tree = { operator: token.kind === "or" ? "|" : "-", left: tree, right: this.term() };
    }
    return tree;
  }

  private term(): Selector {
    let tree = this.factor();
    while (this.peek().kind === "and") {
      this.next++;
      tree = { operator: "&", left: tree, right: this.factor() };
    }
    return tree;
  }

  private factor(): Selector {
    const token = this.peek();
    this.next++;
    if (token.kind === "open") {
      this.depth++;
      if (this.depth > PARENTHESES) {
        throw this.fail(token.at, `it has more than ${PARENTHESES} parentheses in one another`);
      }
      const tree = this.selector();
      this.depth--;
      if (this.peek().kind !== "close") throw this.fail(this.peek().at, "expected ')'");
      this.next++;
      return tree;
    }
    if (token.kind === "star") return EVERYTHING;
    if (token.atom) return token.atom;
    throw this.fail(token.at, "expected a selector such as camera:NAME, '(' or '*'");
  }
}
