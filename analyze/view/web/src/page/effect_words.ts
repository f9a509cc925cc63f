/** What recorded effects say of the words, in sentences: as analyze/commands/effects/answer.py has them. */
import { findPhrase, type Word } from "../grouping/words";
import { type EpisodeEffects, type Item, type Reader, READERS, sizesOf, type Sizes, strongest } from "../measures/effects";
import { formatNumber, formatPercent, plural } from "./number_text";

const MOST_NAMED = 8;
/** So much of a squared effect in one dimension is said, as in analyze/commands/effects/answer.py. */
const MOST_OF_IT = 0.8;
const ALONE: Readonly<Partial<Record<Reader, string>>> = { direct: "the action queries", pictures: "the pictures", text: "the text" };

/** The item of each word, null without one. All places of a word in the instruction are one item. */
export function itemsOfWords({ items }: EpisodeEffects, words: readonly Word[]): (Item | null)[] {
  const found: (Item | null)[] = words.map(() => null);
  for (const item of items) {
    if (item.atom?.kind !== "word") continue;
    for (const word of findPhrase(words, item.atom.argument)) found[words.indexOf(word)] = item;
  }
  return found;
}

/** The mean with what it is of: `0.92 (mean of 9 replans, 0.31 to 1.2)`. */
export function sizeText({ mean, low, high, count }: Sizes): string {
  return formatNumber(mean) + (count > 1 ? ` (mean of ${plural(count, "replan")}, ${formatNumber(low)} to ${formatNumber(high)})` : "");
}

/** What a word's tooltip says, and whether its effect is below the floor. `replan`: null is the mean of the episode. */
export function wordEffect(item: Item | null, { noise }: EpisodeEffects, replan: number | null): { size: Sizes; below: boolean; said: string } {
  const size = item ? strongest(item, replan) : sizesOf(null, null);
  const floor = sizesOf(noise, replan).mean;
  const below = size.mean <= floor;
  if (!item || !size.count) return { size, below: false, said: replan === null ? "no effect was measured" : "no effect was measured at this replan" };
  const verdict = Number.isNaN(floor) ? "of which the noise floor is not known" : `${below ? "below" : "above"} the noise floor of ${formatNumber(floor)}`;
  const alone = READERS.flatMap((reader) =>
    ALONE[reader] && item.by[reader] ? [`from ${ALONE[reader]} alone by ${formatNumber(sizesOf(item.by[reader], replan).mean)}`] : [],
  );
  const total = item.by.total ? `without it the action changes by ${sizeText(size)}, ${verdict}; ` : `${verdict}; `;
  return { size, below, said: `${total}hidden ${alone.join(", ")}` };
}

const atLeastHalf = (part: number, whole: number): boolean => part >= whole / 2;

function listed(items: readonly Item[]): string {
  const names = items.slice(0, MOST_NAMED).map(({ name }) => name);
  return names.join(", ") + (items.length > MOST_NAMED ? ` and ${items.length - MOST_NAMED} more` : "");
}

/** Which word decides, by which way words with large effects reach the action, and the floor; empty without a word's effect. */
export function decidingWord(effects: EpisodeEffects, replan: number | null): string {
  const size = (item: Item): number => strongest(item, replan).mean;
  const words = effects.items.filter((item) => item.atom?.kind === "word" && size(item) >= 0).sort((a, b) => size(b) - size(a));
  const [first] = words;
  if (!first) return "";
  const floor = sizesOf(effects.noise, replan).mean;
  const where = replan === null ? "" : " at this replan";
  const largest = sizeText(strongest(first, replan));
  if (size(first) <= floor) {
    return `No word has an effect above the noise floor${where}: another noise seed changes the action by ${formatNumber(floor)} of its spread, and the largest of ${plural(words.length, "word")}, ${first.name}, by ${largest}.`;
  }
  const without = first.by.total ? "without it" : "hidden from the action queries,";
  const said = `${first.name} has the largest effect of ${plural(words.length, "word")}${where}: ${without} the action changes by ${largest} of its spread.`;
  const of = (item: Item, reader: Reader): number => sizesOf(item.by[reader], replan).mean;
  const large = words.filter((item) => item.by.total && item.by.direct && !(size(item) <= floor));
  const own = large.filter((item) => atLeastHalf(of(item, "direct"), of(item, "total")));
  const others = large.filter((item) => !own.includes(item));
  const through = others.filter((item) => atLeastHalf(of(item, "pictures"), of(item, "total")));
  const rest = others.filter((item) => !through.includes(item));
  const reach = (items: readonly Item[]): string => `${listed(items)} ${items.length === 1 ? "reaches" : "reach"} the action through`;
  const ways = [];
  if (own.length) ways.push(`the action queries read ${listed(own)} themselves`);
  if (through.length) ways.push(`${reach(through)} the pictures, which have read ${through.length === 1 ? "it" : "them"}`);
  if (rest.length) ways.push(`${reach(rest)} other tokens`);
  if (others.length) {
    const amounts = others.map((item) => of(item, "direct")).sort((a, b) => a - b);
    const span = [...new Set([amounts[0], amounts.at(-1)].map(formatNumber))].join(" to ");
    ways.push(`hidden from the action queries alone, ${others.length === 1 ? "that one changes" : "these change"} it by ${span}`);
  }
  const shares = first.shares.total ?? first.shares.direct!;
  const dimension = shares.indexOf(Math.max(...shares));
  const mostly =
    shares[dimension]! >= MOST_OF_IT && effects.spread.filter((one) => one !== null).length > 1
      ? `Of the effect of ${first.name} in this episode, ${formatPercent(shares[dimension]!, 0)} is dimension ${dimension} of the action, whose spread in the store is ${formatNumber(effects.spread[dimension]!)}.`
      : "";
  const text = ways.join("; ");
  const noise = Number.isNaN(floor)
    ? `No other noise seed was tried${where}, so nobody knows the floor of these effects.`
    : `Another noise seed on the same inputs changes the action by ${formatNumber(floor)} of its spread: a smaller effect cannot be told from chance.`;
  return [said, text ? `${text[0]!.toUpperCase()}${text.slice(1)}.` : "", mostly, noise].filter(Boolean).join(" ");
}
