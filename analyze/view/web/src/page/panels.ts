/** Panels beside the page's own parts: each registers itself when it is imported (`src/panels.ts`). */
import type { PictureBoard } from "./picture_board";
import type { Shown } from "./shown";
import type { View } from "./state";
import type { Timeline } from "./timeline";
import type { WordStrip } from "./word_strip";
import type { Store, StoreEntry } from "../store/open";

/** What a panel may use of the page. */
export interface PageContext {
  readonly view: View;
  readonly stores: readonly StoreEntry[];
  openStore(which: number): Promise<Store>;
  /** Say something to those who use a screen reader. */
  announce(text: string): void;
  /** Open what a ratio can and cannot mean. */
  explain(): void;
  readonly pictures: PictureBoard;
  readonly words: WordStrip;
  readonly timeline: Timeline;
}

export interface PanelInstance {
  /** After every change, also while playing: be quick. */
  update(shown: Shown): void;
  destroy?(): void;
}

export interface Panel {
  readonly id: string;
  readonly title: string;
  /** Panels with lower numbers are above. */
  readonly order: number;
  /** `wide`: below the episode, over the width of the page; else in the column at the side. */
  readonly wide?: boolean;
  /** Whether the panel is unfolded when the page opens. */
  readonly open?: boolean;
  mount(host: HTMLElement, page: PageContext): PanelInstance;
}

const registered: Panel[] = [];

export function registerPanel(panel: Panel): void {
  registered.push(panel);
}

/** All panels, in their order. */
export function panels(): readonly Panel[] {
  return [...registered].sort((a, b) => a.order - b.order);
}
