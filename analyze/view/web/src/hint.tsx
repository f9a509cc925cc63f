/** A caveat behind a question mark, for the mouse, the keyboard and the finger. */
export function Hint({ text }: { text: string }) {
  return (
    <details class="hint">
      <summary aria-label="What this means">?</summary>
      <span>{text}</span>
    </details>
  );
}
