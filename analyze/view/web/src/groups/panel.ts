/**
 * "Groups live": a grouping is typed or clicked, and its masses over the episode are there at once. The numbers are those
 * of `vla-analyze`, whose command and file for the same grouping are given.
 */
import "./panel.css";
import { BUILTIN_NAMES } from "../grouping/builtin_groupings";
import { readGroupingFile } from "../grouping/grouping_files";
import { ofReplan } from "../grouping/resolve";
import type { Atom } from "../grouping/selector_parser";
import { attempt } from "../grouping/text";
import { type EpisodeTokens, picturedCameras } from "../grouping/tokens";
import { PictureMap } from "../measures/picture_map";
import type { Place } from "../page/baselines";
import { button, choice, element } from "../page/dom";
import { type PageContext, type PanelInstance, registerPanel } from "../page/panels";
import type { Shown } from "../page/shown";
import { sentenceOf } from "../store/errors";
import { ClickTools } from "./click_tools";
import { groupStyles } from "./colours";
import {
  type Draft,
  draftOfGrouping,
  draftOfText,
  EMPTY_DRAFT,
  type Evaluated,
  evaluateDraft,
  type GroupLine,
  textOfDraft,
} from "./draft";
import { bytesOfRows, cutsSegments, placeKey, valuesOfEpisode } from "./episode_masses";
import { LinesEditor } from "./lines_editor";
import { Output } from "./output";
import { Results } from "./results";
import { paintedPatches, toggledPart } from "./selector_edit";
import { aboutText, freeName } from "./wording";

/** Rows of an episode that are read without being asked for. */
const READ_AT_ONCE = 256_000_000;
/** The part of a patch that a group must take for its outline: objects cover patches in part. */
const OUTLINED = 0.2;
/** The link is written when typing rests for so long, in ms. */
const REST = 400;

class GroupsPanel implements PanelInstance {
  readonly #lines = new LinesEditor({
    change: (lines) => this.#edit({ lines }),
    activate: (line) => this.#activate(line),
  });
  readonly #tools = new ClickTools({ toggle: (atom) => this.#toggle(atom), brush: (on) => this.#brush(on) });
  readonly #results: Results;
  readonly #base = choice("Begin with", "group-base", (value) => this.#edit({ base: value || null, file: null }));
  readonly #ratio = element("input", { type: "text", class: "ratio", "aria-label": "Ratio", placeholder: "groups / groups, as bowl,plate/noun", autocomplete: "off", spellcheck: "false" });
  readonly #overlap = element("input", { type: "checkbox" });
  readonly #problem = element("p", { class: "problem", role: "status", hidden: true });
  readonly #note = element("p", { class: "soft", role: "status" });
  readonly #read = button("Read the rows", () => this.#measure(true), { hidden: true });
  readonly #output: Output;
  #draft: Draft = EMPTY_DRAFT;
  #active = -1;
  #evaluated: Evaluated = { grouping: null, resolved: null, ofLines: [], ofWhole: "" };
  #evaluatedOf: { text: string; tokens: EpisodeTokens } | null = null;
  #shown: Shown | null = null;
  #measuredOf = "";
  #asked = 0;
  #resting: ReturnType<typeof setTimeout> | undefined;
  #measuring = false;
  #outlines: string[] = [];

  constructor(
    private readonly host: HTMLElement,
    private readonly page: PageContext,
  ) {
    this.#results = new Results((replan) => page.view.update({ replan, playing: false }));
    this.#ratio.addEventListener("input", () => this.#edit({ ratio: this.#ratio.value.trim() }));
    this.#overlap.addEventListener("change", () => this.#edit({ overlap: this.#overlap.checked }));
    const file = element("input", { type: "file", accept: ".toml", "aria-label": "Open a grouping file" });
    file.addEventListener("change", () => void this.#openFile(file));
    this.#output = new Output((text) => page.announce(text));
    host.classList.add("groups");
    host.append(
      element(
        "p",
        { class: "soft" },
        "A group is a set of keys: patches, words, objects. Type a selector, or begin a group and click. ",
        "Numbers are means over the stored queries; outlined are the patches of which a group takes a fifth or more.",
      ),
      element("div", { class: "group-bar" }, this.#base.host, button("New group", () => this.#lines.focus(this.#add())), element("label", { class: "beside" }, "Open TOML ", file)),
      this.#lines.host,
      element(
        "div",
        { class: "group-bar" },
        element("label", { class: "beside" }, "Ratio ", this.#ratio),
        element("label", { class: "beside" }, this.#overlap, "groups may overlap"),
      ),
      this.#problem,
      this.#tools.host,
      this.#note,
      this.#read,
      this.#results.host,
      this.#output.host,
    );
    page.words.onWord((_, word) => {
      if (this.#isOpen) this.#toggle({ kind: "word", argument: word.text });
    });
    host.closest("details")?.addEventListener("toggle", () => {
      if (!this.#isOpen) this.#tools.stop();
      this.#refresh();
    });
  }

  update(shown: Shown): void {
    const before = this.#shown;
    this.#shown = shown;
    // The link, or the browser's history, names another grouping; not while one is being typed.
    if (this.#resting === undefined && shown.state.grouping !== textOfDraft(this.#draft)) {
      this.#draft = draftOfText(shown.state.grouping);
      this.#active = Math.min(this.#active, this.#draft.lines.length - 1);
      const folded = this.host.closest("details");
      if (folded && shown.state.grouping && !before) folded.open = true;
    }
    this.#refresh();
  }

  get #isOpen(): boolean {
    return this.host.closest("details")?.open ?? true;
  }

  #place(): Place {
    const { episode, site, tokens, selection } = this.#shown!;
    return { episode, site, tokens, selection };
  }

  // What somebody changes.

  #edit(change: Partial<Draft>): void {
    this.#draft = { ...this.#draft, ...change };
    this.#active = Math.min(this.#active, this.#draft.lines.length - 1);
    clearTimeout(this.#resting);
    this.#resting = setTimeout(() => {
      this.#resting = undefined;
      this.page.view.update({ grouping: textOfDraft(this.#draft) });
      this.#settle();
    }, REST);
    this.#refresh();
  }

  #setLine(line: number, change: Partial<GroupLine>): void {
    this.#edit({ lines: this.#draft.lines.map((one, i) => (i === line ? { ...one, ...change } : one)) });
  }

  /** A new group, into which clicks go. The focus stays where it is: it would scroll the page below a stroke of the brush. */
  #add(name = "group"): number {
    const names = this.#draft.lines.map((line) => line.name);
    this.#active = names.length;
    this.#edit({ lines: [...this.#draft.lines, { name: freeName(name, names), selector: "" }] });
    return this.#active;
  }

  #activate(line: number): void {
    if (this.#active === line) return;
    this.#active = line;
    this.#refresh();
  }

  /** The line that clicks go into; a new one with this name where there is none. */
  #target(name: string): number {
    return this.#active >= 0 ? this.#active : this.#add(name);
  }

  #change(line: number, make: (selector: string) => string | null): void {
    const found = attempt(() => make(this.#draft.lines[line]!.selector));
    if (found.error !== undefined) this.page.announce(found.error);
    else if (found.value === null) this.page.announce("This name cannot be written in a selector.");
    else this.#setLine(line, { selector: found.value });
  }

  #toggle(atom: Atom): void {
    this.#change(this.#target(atom.argument), (selector) => toggledPart(selector, atom));
  }

  #brush(on: boolean): void {
    if (!on) {
      this.page.pictures.brush(null);
      return;
    }
    this.page.pictures.brush({
      paint: (camera, patches, withShift) => {
        const { layout } = this.#shown!.site;
        const erase = withShift || this.#tools.erases;
        this.#change(this.#target("patches"), (selector) => paintedPatches(selector, layout, camera, patches, erase));
      },
      end: () => undefined,
    });
  }

  async #openFile(input: HTMLInputElement): Promise<void> {
    const file = input.files?.[0];
    if (!file) return;
    const text = await file.text();
    input.value = "";
    const found = attempt(() => readGroupingFile(text, file.name));
    if (found.error === undefined) {
      this.#active = -1;
      this.#edit(draftOfGrouping(found.value));
    } else this.#showProblem(found.error);
  }

  /** Say to tests whether the link, the marks and the numbers are those of what is typed. */
  #settle(): void {
    if (this.#resting === undefined && !this.#measuring) this.host.dataset.settled = "1";
    else delete this.host.dataset.settled;
  }

  // What is drawn.

  #refresh(): void {
    const shown = this.#shown;
    if (!shown || (!this.#isOpen && !this.#outlines.length)) return;
    // Replans that are played change neither.
    const text = textOfDraft(this.#draft);
    if (this.#evaluatedOf?.text !== text || this.#evaluatedOf.tokens !== shown.tokens) {
      this.#evaluated = evaluateDraft(this.#draft, shown.tokens);
      this.#evaluatedOf = { text, tokens: shown.tokens };
    }
    const { grouping, resolved, ofLines, ofWhole } = this.#evaluated;
    const { lines, base, ratio, overlap } = this.#draft;
    const colours = groupStyles(grouping ? [...grouping.groups.keys()] : lines.map((line) => line.name));
    const ofName = new Map([...(grouping?.groups.keys() ?? lines.map((line) => line.name))].map((name, i) => [name, colours[i]!.colour]));
    this.#lines.show(lines, this.#active, ofLines, lines.map(({ name }) => ofName.get(name) ?? ""));
    this.#base.show([["", "nothing"], ...BUILTIN_NAMES.map((name) => [name, name] as const)], base ?? "");
    if (this.#ratio.value.trim() !== ratio) this.#ratio.value = ratio;
    this.#overlap.checked = overlap;
    const active = lines[this.#active];
    this.#tools.show(shown.tokens, active?.name ?? "", active?.selector ?? "");
    this.#showProblem(ofWhole);
    this.#outline(ofName);
    const empty = !grouping && !ofWhole && !ofLines.some((problem) => problem);
    const { entry } = shown.store;
    this.#output.show(grouping, this.#draft, entry.path ?? entry.name, this.#place());
    this.#results.markOld(!grouping);
    if (empty) {
      this.#asked++;
      this.#measuring = false;
      this.#measuredOf = "";
      this.#results.clear();
      this.#read.hidden = true;
      this.#note.textContent = "";
    } else if (grouping && resolved) this.#measure(false);
    this.#settle();
  }

  #showProblem(sentence: string): void {
    this.#problem.hidden = !sentence;
    this.#problem.textContent = sentence;
  }

  /** Masses of the present grouping, unless they are shown already. `asked`: somebody wants them however long it takes. */
  #measure(asked: boolean): void {
    const { grouping, resolved } = this.#evaluated;
    const shown = this.#shown!;
    if (!grouping || !resolved) return;
    const place = this.#place();
    const key = `${shown.state.store}|${placeKey(place)}|${textOfDraft(this.#draft)}`;
    if (key === this.#measuredOf && !asked) {
      this.#results.setReplan(shown.replan);
      return;
    }
    this.#measuredOf = key;
    const bytes = bytesOfRows(place);
    this.#read.hidden = asked || bytes <= READ_AT_ONCE || !cutsSegments(resolved, place);
    if (!this.#read.hidden) {
      this.#note.textContent = `These groups need the rows of the whole episode: about ${Math.round(bytes / 1e6)} MB. Choose one layer, or:`;
      this.#results.markOld(true);
      return;
    }
    const now = ++this.#asked;
    this.#measuring = true;
    valuesOfEpisode(grouping, resolved, place).then(
      (replans) => {
        if (now !== this.#asked) return;
        this.#measuring = false;
        this.#note.textContent = "";
        this.#results.markOld(false);
        this.#results.show({ grouping, replans, about: aboutText(place), layers: place.selection.layers.length }, this.#shown!.replan);
        this.#settle();
      },
      (failure: unknown) => {
        if (now !== this.#asked) return;
        this.#measuring = false;
        this.#settle();
        this.#measuredOf = "";
        this.#note.textContent = sentenceOf(failure);
      },
    );
  }

  /** Mark the lines' groups on the pictures and in the instruction, at this replan. */
  #outline(colours: ReadonlyMap<string, string>): void {
    const { tokens, replan, words } = this.#shown!;
    const { resolved } = this.#evaluated;
    const drawn = this.#isOpen && resolved ? [...new Set(this.#draft.lines.map((line) => line.name))] : [];
    for (const name of this.#outlines.filter((old) => !drawn.includes(old))) {
      this.page.pictures.setOutline(`group:${name}`, name, "", null);
      this.page.words.mark(`group:${name}`, new Set(), "");
    }
    this.#outlines = drawn;
    for (const name of drawn) {
      const group = resolved!.names.indexOf(name);
      const own = ofReplan(resolved!.weights, replan).subarray(group * tokens.keys, (group + 1) * tokens.keys);
      const members = new Map<string, Uint8Array>();
      for (const camera of picturedCameras(tokens.layout)) {
        const cells = new PictureMap(tokens.layout, camera).highest(own);
        members.set(camera, Uint8Array.from(cells, (weight) => (weight >= OUTLINED ? 255 : 0)));
      }
      this.page.pictures.setOutline(`group:${name}`, name, colours.get(name)!, members);
      const places = words.flatMap((word, i) => (word.keys.length && word.keys.every((key) => own[key]! >= 0.5) ? [i] : []));
      this.page.words.mark(`group:${name}`, new Set(places), colours.get(name)!);
    }
  }
}

registerPanel({
  id: "groups",
  title: "Groups live",
  order: 10,
  wide: true,
  mount: (host, page) => new GroupsPanel(host, page),
});
