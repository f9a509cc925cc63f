/** The words of a prompt at the keys of one site. */
import type { PieceDocument, PromptDocument, SiteDocument, SpanDocument } from "./documents";

/** The prompt with its pieces at the keys of one site; the same as schemas/layout.py, `prompt_at`. */
export function promptAtSite(sites: readonly SiteDocument[], layout: SiteDocument, prompt: PromptDocument): PromptDocument {
  const textsOf = (site: SiteDocument): SpanDocument[] => site.spans.filter((span) => span.kind === "text");
  const first = sites.find((site) => textsOf(site).length > 0) ?? layout;
  const own = new Map(textsOf(layout).map((span) => [span.name, span]));
  const texts = textsOf(first);
  if (texts.every((span) => own.get(span.name)?.start === span.start && own.get(span.name)?.stop === span.stop)) return prompt;
  const pieces: PieceDocument[] = [];
  for (const piece of prompt.pieces) {
    const span = texts.find((each) => each.start <= piece.key && piece.key < each.stop);
    const there = span && own.get(span.name);
    if (span && there && piece.key - span.start < there.stop - there.start) {
      pieces.push({ ...piece, key: piece.key - span.start + there.start });
    }
  }
  return { ...prompt, pieces };
}
