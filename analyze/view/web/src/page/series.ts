/** The lines of the timeline: ratio and masses at every replan. */
import type { EpisodeNumbers } from "./episode_numbers";
import type { TimelineSeries } from "./timeline";

/** Colours of the groups, as CSS variables (light and dark); they are those of analyze/show/plot_colours.py. */
const COLOURS: Readonly<Record<string, string>> = {
  visual: "var(--visual)",
  linguistic: "var(--linguistic)",
  state: "var(--state)",
  action: "var(--action)",
};

export interface TimelineRow {
  title: string;
  series: TimelineSeries[];
  logarithmic: boolean;
  /** Whether each line is named beside the title. */
  named: boolean;
}

/** The rows of the chart of an episode. */
export function rowsOfTimeline({ grouping, present, replans }: EpisodeNumbers): Map<string, TimelineRow> {
  const rows = new Map<string, TimelineRow>();
  if (grouping.ratio) {
    rows.set("ratio", {
      title: "ratio (logarithmic; broken: uniform)",
      logarithmic: true,
      named: false,
      series: [
        {
          name: "ratio",
          colour: "var(--accent)",
          values: replans.map((replan) => replan.ratio!.value),
          uniform: replans.map((replan) => replan.ratio!.uniform),
          unit: "",
        },
      ],
    });
  }
  const names = [...grouping.groups.keys()];
  const series = present
    .filter((name) => name in COLOURS)
    .map((name) => ({
      name,
      colour: COLOURS[name]!,
      values: replans.map((replan) => replan.groups.mass[names.indexOf(name)]!),
      unit: "",
    }));
  if (series.length) rows.set("masses", { title: "mass", logarithmic: false, named: true, series });
  return rows;
}
