/**
 * Masses and ratio of the grouping `default` at every replan, and of every head, from the stored segment masses.
 *
 * All arithmetic is that of `measures/`, which gives the numbers of `vla-analyze ratios`.
 */
import { findGrouping } from "../grouping/builtin_groupings";
import type { Grouping } from "../grouping/grouping";
import { ofReplan, resolve, type ResolvedGrouping } from "../grouping/resolve";
import { type EpisodeTokens, vocabularyOf } from "../grouping/tokens";
import { groupMeasures, type GroupMeasures } from "../measures/masses";
import { layerMasses, type ReplanValues, replanValues } from "../measures/replans";
import { weightsOnSegments, withValid } from "../measures/segments";
import type { Atoms, Selection, SiteInfo } from "../store/episode";
import { StoreError } from "../store/errors";
import { type Place, uniformOfGroups, uniformOfLayers } from "./baselines";

export interface EpisodeNumbers {
  readonly grouping: Grouping;
  /** Groups that have keys in this episode, in the order of the grouping. */
  readonly present: readonly string[];
  /** Of each replan, mean over the selection. */
  readonly replans: readonly ReplanValues[];
  /** Measures of every group at a replan in one layer and head (positions), mean over the selection's denoise steps. */
  cell(replan: number, layer: number, head: number): GroupMeasures;
}

interface Known {
  grouping: Grouping;
  resolved: ResolvedGrouping;
  weights: Float32Array[];
  onSegments: Float32Array[];
}

const known = new WeakMap<EpisodeTokens, Known>();

function knownOf(tokens: EpisodeTokens, site: SiteInfo): Known {
  let found = known.get(tokens);
  if (!found) {
    const grouping = findGrouping("default", vocabularyOf([tokens]));
    const resolved = resolve(grouping, tokens);
    const weights = withValid(resolved, tokens);
    const onSegments = weightsOnSegments(weights, tokens, site.segments);
    if (!onSegments) throw new StoreError(`The segments of site ${site.layout.name} do not fit its roles: the store is damaged.`);
    found = { grouping, resolved, weights, onSegments };
    known.set(tokens, found);
  }
  return found;
}

/** Segment masses (replan, segment) of one layer, mean over denoise steps and heads. */
export function meanAtoms(atoms: Atoms, layer: number, selection: Selection): Float64Array {
  const { replans, layers, denoise, heads, segments, values } = atoms;
  const mean = new Float64Array(replans * segments);
  const number = selection.denoise.length * selection.heads.length;
  for (let replan = 0; replan < replans; replan++) {
    for (const step of selection.denoise) {
      for (const head of selection.heads) {
        const at = (((replan * layers + layer) * denoise + step) * heads + head) * segments;
        for (let i = 0; i < segments; i++) mean[replan * segments + i]! += values[at + i]! / number;
      }
    }
  }
  return mean;
}

/** The numbers of an episode for one selection. */
export async function episodeNumbers(place: Place): Promise<EpisodeNumbers> {
  const { episode, site, tokens, selection } = place;
  const { grouping, resolved, weights, onSegments } = knownOf(tokens, site);
  const [atoms, uniform, uniformOfCells] = await Promise.all([
    episode.atoms(site.layout.name, selection.query),
    uniformOfLayers(place, weights),
    Promise.all(
      site.layers.map((_, layer) =>
        Promise.all(
          site.heads.map((__, head) =>
            uniformOfGroups({ ...place, selection: { ...selection, layers: [layer], heads: [head] } }, weights),
          ),
        ),
      ),
    ),
  ]);
  const { segments } = atoms;
  const layers = selection.layers.map((layer) => layerMasses(meanAtoms(atoms, layer, selection), onSegments, segments));
  const groups = resolved.names.length;
  return {
    grouping,
    present: resolved.names.filter((_, group) => resolved.numKeys.some((numbers) => numbers[group]! > 0)),
    replans: replanValues(layers, uniform, grouping, resolved),
    cell(replan, layer, head) {
      const mean = new Float64Array(segments);
      for (const step of selection.denoise) {
        const at = (((replan * atoms.layers + layer) * atoms.denoise + step) * atoms.heads + head) * segments;
        for (let i = 0; i < segments; i++) mean[i]! += atoms.values[at + i]! / selection.denoise.length;
      }
      const { values } = layerMasses(mean, [ofReplan(onSegments, replan)], segments);
      const own = ofReplan(uniformOfCells[layer]![head]!, replan);
      return groupMeasures(values.slice(0, groups), values[groups]!, ofReplan(resolved.numKeys, replan), own);
    },
  };
}
