/** Groups without typing: a brush on the pictures, and the names of the episode as buttons. */
import type { Atom } from "../grouping/selector_parser";
import { camerasOf, type EpisodeTokens, roleLabel } from "../grouping/tokens";
import { button, element } from "../page/dom";
import { hasPart } from "./selector_edit";

export interface ClickListener {
  /** A name was clicked: it is added to the active group, or taken out of it. */
  toggle(atom: Atom): void;
  /** The brush was switched on or off. */
  brush(on: boolean): void;
}

interface Names {
  label: string;
  kind: string;
  names: readonly string[];
}

export class ClickTools {
  readonly host = element("div", { class: "click-tools" });
  readonly #note = element("p", { class: "soft" });
  readonly #brush = button("Brush on the pictures", () => this.#switch(), { "aria-pressed": "false", class: "brush" });
  readonly #erase = button("Erase", () => this.#switchErase(), { "aria-pressed": "false", class: "erase", hidden: true });
  readonly #lists = element("div");
  #buttons: { made: HTMLButtonElement; atom: Atom }[] = [];
  #built: unknown = null;
  #brushing = false;

  constructor(private readonly on: ClickListener) {
    this.host.append(this.#note, element("div", { class: "group-bar" }, this.#brush, this.#erase), this.#lists);
  }

  /** Draw the names of an episode, pressed where the active group's selector has them. */
  show(tokens: EpisodeTokens, name: string, selector: string): void {
    if (this.#built !== tokens) this.#build(tokens);
    this.#note.textContent = name
      ? `Clicks on names, on words of the instruction and the brush go into "${name}". A second click takes out again.`
      : "A click on a name or on a word of the instruction, or the brush, begins a group.";
    for (const { made, atom } of this.#buttons) made.setAttribute("aria-pressed", String(hasPart(selector, atom)));
  }

  /** Whether the brush takes patches out, as it does with Shift: a finger has no keys. */
  get erases(): boolean {
    return this.#erase.getAttribute("aria-pressed") === "true";
  }

  /** Put the brush away. */
  stop(): void {
    if (this.#brushing) this.#switch();
  }

  #switch(): void {
    this.#brushing = !this.#brushing;
    this.#brush.setAttribute("aria-pressed", String(this.#brushing));
    this.#brush.textContent = this.#brushing ? "Brush is on: drag over a picture" : "Brush on the pictures";
    this.#erase.hidden = !this.#brushing;
    this.#erase.setAttribute("aria-pressed", "false");
    this.on.brush(this.#brushing);
  }

  #switchErase(): void {
    this.#erase.setAttribute("aria-pressed", String(!this.erases));
  }

  #build(tokens: EpisodeTokens): void {
    this.#built = tokens;
    this.#buttons = [];
    const { layout } = tokens;
    this.#brush.hidden = !layout.spans.some((span) => span.camera && span.grid);
    const codes = [...new Set(tokens.keyRole.codes)].sort((a, b) => a - b);
    const objects = tokens.coverage.size ? tokens.objects.map((thing) => thing.name) : [];
    const classes = objects.length ? ["@interest", "@robot", "@background"] : [];
    const hasWords = tokens.words.some((line) => line.some((word) => word.keys.length));
    const lists: Names[] = [
      { label: "Objects", kind: "object", names: [...objects, ...classes] },
      { label: "Words", kind: "words", names: hasWords ? ["all", "content", "stop"] : [] },
      { label: "Cameras", kind: "camera", names: camerasOf(layout) },
      { label: "Frames", kind: "frame", names: layout.spans.filter((span) => span.kind === "latent").map((span) => span.name) },
      { label: "Roles", kind: "role", names: codes.map(roleLabel) },
    ];
    this.#lists.replaceChildren(
      ...lists.filter(({ names }) => names.length).map(({ label, kind, names }) => {
        const made = names.map((name) => {
          const atom = { kind, argument: name };
          const own = button(name, () => this.on.toggle(atom), { "aria-pressed": "false", "data-part": `${kind}:${name}` });
          this.#buttons.push({ made: own, atom });
          return own;
        });
        return element("div", { class: "names", role: "group", "aria-label": label }, element("span", { class: "soft" }, label), ...made);
      }),
    );
  }
}
