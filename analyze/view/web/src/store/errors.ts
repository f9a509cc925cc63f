/** A store that cannot be read, or not be shown. The message is a sentence for the person who looks at the page. */
export class StoreError extends Error {
  override name = "StoreError";
}

/** A file that the store does not have. */
export class NotThere extends StoreError {
  override name = "NotThere";
}

/** The sentence of any failure. zarrita wraps what a codec throws: the first cause says what happened. */
export function sentenceOf(failure: unknown): string {
  let first = failure;
  while (first instanceof Error && first.cause instanceof Error) first = first.cause;
  return first instanceof Error ? first.message : String(first);
}

const SHOWN = 300;

/** A text as a sentence can hold it: control and format characters as escapes, at most 300 characters. */
export function visible(text: string): string {
  const escaped = text.replace(/[\p{Cc}\p{Cf}\p{Co}\p{Cs}\p{Zl}\p{Zp}]/gu, (character) => {
    const code = character.codePointAt(0)!;
    return `\\u{${code.toString(16)}}`;
  });
  return escaped.length > SHOWN ? `${escaped.slice(0, SHOWN)}...` : escaped;
}
