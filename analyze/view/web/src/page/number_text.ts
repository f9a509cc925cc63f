/** Numbers as text, in the form of analyze/show/numbers.py. A value that does not exist is printed as -. */

/** Three to four significant digits: at most five characters from 0.001 to 99999, else as 1.2e-05. */
export function formatNumber(value: number | null | undefined): string {
  if (value === null || value === undefined || Number.isNaN(value)) return "-";
  if (!Number.isFinite(value)) return value > 0 ? "inf" : "-inf";
  const size = Math.abs(value);
  if (size !== 0 && (size < 0.001 || size >= 99999.5)) {
    const [mantissa, exponent] = value.toExponential(1).split("e") as [string, string];
    return `${mantissa}e${exponent[0]}${exponent.slice(1).padStart(2, "0")}`;
  }
  if (size >= 999.5 || Number.isInteger(value)) return value.toFixed(0);
  return value.toFixed(size >= 99.95 ? 1 : size >= 9.995 ? 2 : 3);
}

/** A share as per cent: 0.125 as 12.5%. */
export function formatPercent(share: number | null | undefined, decimals = 1): string {
  return share === null || share === undefined || Number.isNaN(share) ? "-" : `${(100 * share).toFixed(decimals)}%`;
}

/** The outcome of an episode in a word or two. */
export function outcomeWord(success: boolean | null): string {
  return success === null ? "outcome not known" : success ? "success" : "failure";
}

/** `1 replan`, `2 replans`. */
export function plural(count: number, noun: string): string {
  return count === 1 ? `1 ${noun}` : `${count} ${noun}s`;
}
