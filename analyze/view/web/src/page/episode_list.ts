/** Episodes and tasks with success and ratio: searched, sorted, and chosen from. */
import { visible } from "../store/errors";
import { button, choice, element } from "./dom";
import { formatNumber, outcomeWord, plural } from "./number_text";
import type { EpisodeSummary, StoreEntry, Summary } from "../store/open";
import type { View } from "./state";

const SORTS = {
  name: "task and episode",
  ratio: "ratio, highest first",
  "ratio-low": "ratio, lowest first",
  success: "solved first",
  failure: "not solved first",
  instruction: "instruction",
} as const;
type Sort = keyof typeof SORTS;

/** Rows that are drawn at once; the search finds the others. */
const MOST_ROWS = 500;

type Row = Pick<EpisodeSummary, "name"> & Partial<EpisodeSummary>;

const order: Readonly<Record<Sort, (a: Row, b: Row) => number>> = {
  name: () => 0,
  ratio: (a, b) => (b.ratio ?? -Infinity) - (a.ratio ?? -Infinity),
  "ratio-low": (a, b) => (a.ratio ?? Infinity) - (b.ratio ?? Infinity),
  success: (a, b) => Number(b.success === true) - Number(a.success === true),
  failure: (a, b) => Number(b.success === false) - Number(a.success === false),
  instruction: (a, b) => (a.instruction ?? "").localeCompare(b.instruction ?? ""),
};

/** What people call outcomes; "not solved" is looked for as "unsolved", for "solved" must not find it. */
const SOLVED = ["solved", "success", "successful", "succeeded"];
const FAILED = ["unsolved", "unsuccessful", "failed", "failure", "fails", "not"];

/** The rows that hold all words of a search in their name, task or instruction, or begin their outcome, sorted. */
export function found<T extends Row>(rows: readonly T[], search: string, sort: Sort): T[] {
  const words = search.toLowerCase().replace(/\bnot\s+(?=s)/g, "un").split(/\s+/).filter(Boolean);
  const fits = (row: T): boolean => {
    const text = [row.name, row.task, row.instruction].join(" ").toLowerCase();
    const outcome = row.success === true ? SOLVED : row.success === false ? FAILED : outcomeWord(null).split(" ");
    return words.every((word) => text.includes(word) || outcome.some((one) => one.startsWith(word)));
  };
  return rows.filter(fits).sort(order[sort]);
}

export class EpisodeList {
  readonly host = element("nav", { class: "episodes", "aria-label": "Episodes" });
  readonly #stores = choice("Store", "store", (value) =>
    this.view.update({ store: Number(value), episode: null, site: null, replan: 0, layer: "mean", head: "mean", denoise: "mean", query: "mean" }),
  );
  readonly #search = element("input", { type: "search", name: "search", placeholder: "task, words, success ...", "aria-label": "Search episodes" });
  readonly #sort = choice("Sort by", "sort", () => this.#draw());
  readonly #note = element("p", { class: "soft", role: "status" });
  readonly #rows = element("ol", {});
  #entry: StoreEntry | null = null;
  #summary: Summary | null = null;

  constructor(private readonly view: View) {
    this.host.append(this.#stores.host, this.#search, this.#sort.host, this.#note, this.#rows);
    this.#sort.show(Object.entries(SORTS), "name");
    this.#search.addEventListener("input", () => this.#draw());
  }

  showStores(stores: readonly StoreEntry[], store: number): void {
    this.#stores.show(stores.map((entry, i) => [String(i), entry.name]), String(store));
    this.#stores.host.hidden = stores.length < 2;
  }

  showEpisodes(entry: StoreEntry, summary: Summary | null): void {
    this.#entry = entry;
    this.#summary = summary;
    this.#draw();
  }

  focusSearch(): void {
    this.#search.focus();
  }

  /** Mark the shown episode. */
  markShown(): void {
    const { episode } = this.view.get();
    for (const row of this.#rows.querySelectorAll<HTMLButtonElement>("button[data-episode]")) {
      if (row.dataset.episode === episode) row.setAttribute("aria-current", "true");
      else row.removeAttribute("aria-current");
    }
  }

  /** The episode before (-1) or after (1) the shown one, in the order of the list. */
  neighbour(step: number): string | null {
    const names = [...this.#rows.querySelectorAll<HTMLButtonElement>("button[data-episode]")].map((row) => row.dataset.episode!);
    return names[names.indexOf(this.view.get().episode ?? "") + step] ?? null;
  }

  #draw(): void {
    if (!this.#entry) return;
    const measured = new Map(this.#summary?.episodes.map((each) => [each.name, each]));
    const all: Row[] = this.#entry.episodes.map((each) => measured.get(each.name) ?? each);
    const rows = found(all, this.#search.value, (this.#sort.host.querySelector("select")?.value as Sort) ?? "name");
    const outcomes = this.#summary?.episodes.filter((each) => each.success !== null) ?? [];
    const solved = outcomes.filter((each) => each.success).length;
    const parts = [rows.length === all.length ? plural(all.length, "episode") : `${rows.length} of ${plural(all.length, "episode")}`];
    if (outcomes.length) parts.push(`${solved} of ${outcomes.length} solved`);
    if (this.#summary?.ratio) parts.push(`number: ratio ${this.#summary.ratio}, geometric mean over replans and layers`);
    if (rows.length > MOST_ROWS) parts.push(`the first ${MOST_ROWS} are listed`);
    if (this.#summary?.failed) parts.push(`ratios are missing: ${this.#summary.failed}`);
    else if (this.#summary && !this.#summary.complete) parts.push("ratios are being measured");
    this.#note.textContent = parts.join(", ");
    this.#rows.replaceChildren(...rows.slice(0, MOST_ROWS).map((row) => this.#row(row)));
    this.markShown();
  }

  #row(row: Row): HTMLElement {
    const outcome = row.success === undefined ? "" : row.success === null ? "?" : row.success ? "✓" : "✗";
    const kind = row.success === true ? "solved" : row.success === false ? "failed" : "unknown";
    const made = button("", () => this.view.update({ episode: row.name, replan: 0, playing: false }), { "data-episode": row.name });
    const ratio = row.ratio === undefined ? "" : formatNumber(row.ratio);
    const said = (text: string): HTMLElement => element("span", { class: "unseen" }, text);
    made.append(
      element("span", { class: `outcome ${kind}` }, element("span", { "aria-hidden": "true" }, outcome), said(row.success === undefined ? "" : `${outcomeWord(row.success)} `)),
      element(
        "span",
        { class: "what" },
        element("span", {}, visible(row.instruction ?? "") || row.name),
        element("small", { class: "soft" }, row.instruction ? row.name : ""),
      ),
      said(ratio ? " ratio " : ""),
      element("span", { class: "ratio", "data-ratio": row.ratio ?? "" }, ratio),
    );
    return element("li", {}, made);
  }
}
