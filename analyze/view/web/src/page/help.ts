/** The dialog with keys, and with what the numbers mean. */
import { button, element } from "./dom";

export const KEYS: readonly (readonly [string, string])[] = [
  ["← →", "replan before or after; with shift ten at once"],
  ["Home, End", "first or last replan"],
  ["space", "play or stop"],
  ["[ ]", "layer before or after"],
  [", .", "head before or after"],
  ["- +", "denoise step before or after"],
  ["0", "mean over layers, heads, denoise steps and queries"],
  ["v", "next of lift, raw, rank"],
  ["w", "words shaded by effect, effect at this replan, attention (where effects were recorded)"],
  ["c", "next colours"],
  ["s", "smooth or blocks"],
  ["n p", "next or previous episode of the list"],
  ["/", "search episodes"],
  ["?", "this help"],
];

const MEANING: readonly (readonly [string, string])[] = [
  ["Share, lift, rank", "A share is the part of all attention that a key gets. Lift divides it by what uniform attention gives the key, where each query gives the same to every key that it sees: 1 is uniform. Rank orders the valid keys, 100% is the one with most."],
  ["Ratio", "Attention on picture keys divided by attention on words. With 512 patches and a dozen words, attention that ignores content has a ratio of about 43: compare with the uniform ratio, or read the lift."],
  ["What it can mean", "Where the action queries of these layers looked. A key without mass in any head of any layer adds nothing there."],
  ["What it cannot mean", "That the policy used what it looked at, or would act differently without it. In a deep layer a patch's key also carries words, and a word's key pictures. Only an intervention shows an effect."],
  ["Effect", "How far the executed actions change when nobody reads a word, a part of the prompt or a picture: root mean square, each dimension in units of its spread over all actions of the store. Without it the policy sees what it never saw in training. What another noise seed changes is the floor: an effect below it is none. Effects do not add up."],
  ["Means", "A mean over layers or heads may describe none of them: look at the grid. Some heads put their attention on keys that hold little (sinks)."],
  ["Checksums", "Every chunk is compared with its checksum (crc32c). The page does not compare seals: run vla-attention store verify before you believe a store from somebody else."],
];

export class Help {
  readonly dialog = element("dialog", { class: "help", "aria-labelledby": "help-title" });

  constructor() {
    const list = (rows: readonly (readonly [string, string])[], tag: "kbd" | "strong"): HTMLElement =>
      element("dl", { class: tag }, ...rows.flatMap(([term, text]) => [element("dt", {}, element(tag, {}, term)), element("dd", {}, text)]));
    const close = button("Close", () => this.dialog.close());
    this.dialog.append(
      element("h2", { id: "help-title" }, "Help"),
      element("h3", {}, "Keys"),
      list(KEYS, "kbd"),
      element("p", { class: "soft" }, "On a picture: Enter, then arrow keys move over its patches, Escape leaves. In the grid arrow keys move from head to head."),
      element("h3", { id: "help-meaning" }, "What the numbers can and cannot mean"),
      list(MEANING, "strong"),
      element("p", { class: "soft" }, "docs/interpreting.md of vla-attention says more, with its sources."),
      close,
    );
  }

  open(meaning = false): void {
    if (!this.dialog.open) this.dialog.showModal();
    if (meaning) this.dialog.querySelector("#help-meaning")?.scrollIntoView();
    else this.dialog.scrollTop = 0;
  }
}
