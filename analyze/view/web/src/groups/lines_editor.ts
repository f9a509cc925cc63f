/** The groups as lines to type: a name and a selector each, what is wrong beside it, and which one clicks go into. */
import { button, element } from "../page/dom";
import { onPage } from "./colours";
import type { GroupLine } from "./draft";
import { trimmed } from "../grouping/text";

interface Row {
  host: HTMLElement;
  mark: HTMLButtonElement;
  name: HTMLInputElement;
  selector: HTMLInputElement;
  remove: HTMLButtonElement;
  problem: HTMLElement;
}

export interface LinesListener {
  change(lines: GroupLine[]): void;
  activate(line: number): void;
}

export class LinesEditor {
  readonly host = element("div", { class: "group-lines" });
  #rows: Row[] = [];

  constructor(private readonly on: LinesListener) {}

  /** Draw the lines; a field that somebody types in keeps its text. */
  show(lines: readonly GroupLine[], active: number, problems: readonly string[], colours: readonly string[]): void {
    while (this.#rows.length > lines.length) this.#rows.pop()!.host.remove();
    while (this.#rows.length < lines.length) this.#append();
    lines.forEach(({ name, selector }, i) => {
      const row = this.#rows[i]!;
      for (const [field, text] of [[row.name, name], [row.selector, selector]] as const) {
        if (trimmed(field.value) !== text) field.value = text;
      }
      row.mark.setAttribute("aria-pressed", String(i === active));
      row.mark.setAttribute("aria-label", `Clicks go into the group ${name || i + 1}`);
      row.mark.style.setProperty("--own", colours[i] ? onPage(colours[i]) : "");
      row.remove.setAttribute("aria-label", `Remove the group ${name || i + 1}`);
      row.host.classList.toggle("active", i === active);
      const problem = problems[i] ?? "";
      if (row.problem.textContent !== problem) row.problem.textContent = problem;
      row.problem.hidden = !problem;
      row.selector.setAttribute("aria-invalid", String(problem !== ""));
    });
  }

  /** Put the typing into a line: its selector, or the name of one that has none. */
  focus(line: number): void {
    const row = this.#rows[line];
    (row?.name.value ? row.selector : row?.name)?.focus();
  }

  #append(): void {
    const number = this.#rows.length;
    const changed = (): void => this.on.change(this.#rows.map((row) => ({ name: trimmed(row.name.value), selector: trimmed(row.selector.value) })));
    const field = (what: string, placeholder: string): HTMLInputElement => {
      const made = element("input", {
        type: "text",
        class: what,
        "aria-label": `${what === "name" ? "Name" : "Selector"} of group ${number + 1}`,
        placeholder,
        autocomplete: "off",
        autocapitalize: "off",
        spellcheck: "false",
      });
      made.addEventListener("input", changed);
      made.addEventListener("focus", () => this.on.activate(number));
      return made;
    };
    const row: Row = {
      host: element("div", { class: "group-line", "data-line": number }),
      mark: button("", () => this.on.activate(number), { class: "mark", title: "Clicks go into this group" }),
      name: field("name", "name"),
      selector: field("selector", "selector, as object:plate_1 | word:plate"),
      remove: button("×", () => this.#remove(number), { class: "remove", title: "Remove this group" }),
      problem: element("p", { class: "problem", id: `group-problem-${number}`, role: "status", hidden: true }),
    };
    row.selector.setAttribute("aria-describedby", row.problem.id);
    row.host.append(row.mark, row.name, element("span", { "aria-hidden": "true" }, "="), row.selector, row.remove, row.problem);
    this.#rows.push(row);
    this.host.append(row.host);
  }

  #remove(line: number): void {
    const left = this.#rows.filter((_, i) => i !== line);
    this.on.change(left.map((row) => ({ name: trimmed(row.name.value), selector: trimmed(row.selector.value) })));
  }
}
