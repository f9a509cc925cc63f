/** The masses of any grouping over an episode, from segment masses where it cuts no segment, else from rows. */
import type { Grouping } from "../grouping/grouping";
import type { ResolvedGrouping } from "../grouping/resolve";
import { layerMasses, type ReplanValues, replanValues } from "../measures/replans";
import { weightsOnSegments, withValid } from "../measures/segments";
import { type Place, uniformOfLayers } from "../page/baselines";
import { meanAtoms } from "../page/episode_numbers";
import type { Selection } from "../store/episode";

/** One text for each place and selection, equal where the rows are. */
export function placeKey({ episode, site, selection }: Place): string {
  const { layers, denoise, heads } = selection;
  return [episode.name, site.layout.name, layers.join(), denoise.join(), heads.join()].join("|");
}

/** Decoded bytes of the rows that masses of a grouping that cuts segments are computed from. */
export function bytesOfRows({ episode, site, selection }: Place): number {
  const cells = selection.layers.length * selection.denoise.length;
  return 4 * episode.numReplans * cells * site.heads.length * site.numQueries * site.keys;
}

/** Whether the grouping needs rows. */
export function cutsSegments(resolved: ResolvedGrouping, { tokens, site }: Place): boolean {
  return weightsOnSegments(withValid(resolved, tokens), tokens, site.segments) === null;
}

/** The values of every replan, means over all stored queries: the rows of `replans` and `replans_groups` that `vla-analyze` writes. */
export async function valuesOfEpisode(
  grouping: Grouping,
  resolved: ResolvedGrouping,
  place: Place,
): Promise<ReplanValues[]> {
  const { episode, site, tokens } = place;
  const selection: Selection = { ...place.selection, query: "mean" };
  const weights = withValid(resolved, tokens);
  const uniform = uniformOfLayers({ ...place, selection }, weights);
  const onSegments = weightsOnSegments(weights, tokens, site.segments);
  const name = site.layout.name;
  if (onSegments) {
    const [atoms, given] = await Promise.all([episode.atoms(name), uniform]);
    const own = (layer: number): Float64Array => meanAtoms(atoms, layer, selection);
    const layers = selection.layers.map((layer) => layerMasses(own(layer), onSegments, atoms.segments));
    return replanValues(layers, given, grouping, resolved);
  }
  const [given, ...rows] = await Promise.all([
    uniform,
    ...selection.layers.map((layer) => episode.meanRows(name, { ...selection, layers: [layer] })),
  ]);
  const layers = rows.map(({ values, keys }) => layerMasses(values, weights, keys));
  return replanValues(layers, given, grouping, resolved);
}
