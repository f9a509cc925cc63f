/** What is taken away from the panel: the grouping as a TOML file, and the command that makes the same numbers. */
import type { Grouping } from "../grouping/grouping";
import { writeGroupingFile } from "../grouping/grouping_files";
import { button, element } from "../page/dom";
import { argumentsOfDraft, type Draft, shellWord } from "./draft";
import type { Place } from "../page/baselines";
import { selectionArguments } from "./wording";

const COPY = "Copy the command";

export class Output {
  readonly host = element("div", { class: "group-output", hidden: true });
  readonly #source = element("p", { class: "soft" });
  readonly #command = element("code", { class: "command", "data-command": "" });
  readonly #copy = button(COPY, () => void this.#copyCommand());
  #grouping: Grouping | null = null;

  /** `announce` says something to those who use a screen reader. */
  constructor(private readonly announce: (text: string) => void) {
    const save = button("Save as TOML", () => this.#save());
    this.host.append(element("div", { class: "group-bar" }, save, this.#copy), this.#source, this.#command);
  }

  /** Offer a grouping; null: there is none. `path`: where the store is. */
  show(grouping: Grouping | null, draft: Draft, path: string, place: Place): void {
    this.#grouping = grouping;
    this.host.hidden = !grouping;
    if (!grouping) return;
    const given = argumentsOfDraft(draft);
    const words = ["vla-analyze", path, ...(given ?? ["--grouping", fileName(grouping)]), ...selectionArguments(place)];
    this.#source.textContent = given ? "The same numbers by" : "The same numbers by, after the file is saved,";
    this.#command.textContent = words.map(shellWord).join(" ");
  }

  #save(): void {
    if (!this.#grouping) return;
    const link = element("a", { download: fileName(this.#grouping) });
    link.href = URL.createObjectURL(new Blob([writeGroupingFile(this.#grouping)], { type: "application/toml" }));
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  }

  async #copyCommand(): Promise<void> {
    try {
      await navigator.clipboard.writeText(this.#command.textContent ?? "");
      this.announce("The command is copied.");
      this.#copy.textContent = "Copied";
      setTimeout(() => (this.#copy.textContent = COPY), 1500);
    } catch {
      getSelection()?.selectAllChildren(this.#command);
      this.announce("The browser does not let this page copy: the command is selected, press Ctrl+C.");
    }
  }
}

function fileName(grouping: Grouping): string {
  return `${grouping.name.replace(/[^\w+.-]/g, "_").slice(0, 60) || "grouping"}.toml`;
}
