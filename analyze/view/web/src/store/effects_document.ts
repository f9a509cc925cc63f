/** What the arrays of an episode's effects are of: `EpisodeEffects` of schemas/effects.py, checked as there. */
import { StoreError } from "./errors";
import { finite, flag, list, object, oneOf, text, whole, wholes } from "./json_fields";
import * as limits from "./limits";

/** Keys that are taken away, and from whose queries. */
export interface KnockoutDocument {
  selector: string;
  keep: boolean;
  queries: "action" | "all" | "prefix";
  query_selector: string;
  random_seed: number | null;
}

export interface ConditionDocument {
  name: string;
  keys: KnockoutDocument[];
  /** Another noise seed. */
  noise: boolean;
  /** Whether anything else is changed: attention, the prompt, pictures. */
  more: boolean;
}

/** Entry i of the arrays is of replan `replan[i]` under `conditions[condition[i]]`. */
export interface EffectsDocument {
  conditions: ConditionDocument[];
  /** How far a change of 1 moves the robot, by dimension of the action. */
  units: number[];
  replan: number[];
  condition: number[];
}

function parseCondition(value: unknown, where: string): ConditionDocument {
  const fields = object(value, where);
  const changes = (of: string): number => list(fields[of] ?? [], `${where}.${of}`, limits.LISTED).length;
  return {
    name: text(fields.name, `${where}.name`),
    keys: list(fields.keys ?? [], `${where}.keys`, limits.LISTED).map((each, i) => {
      const at = `${where}.keys[${i}]`;
      const keys = object(each, at);
      return {
        selector: text(keys.selector, `${at}.selector`),
        keep: flag(keys.keep ?? false, `${at}.keep`),
        queries: oneOf(keys.queries ?? "action", `${at}.queries`, ["action", "all", "prefix"]),
        query_selector: text(keys.query_selector ?? "", `${at}.query_selector`),
        random_seed: keys.random_seed == null ? null : whole(keys.random_seed, `${at}.random_seed`, Number.MAX_VALUE),
      };
    }),
    noise: fields.noise != null,
    more: changes("attention") + changes("images") > 0 || fields.prompt != null,
  };
}

/** The attribute `effects` of an episode; null where none were measured. */
export function parseEffects(value: unknown, replans: number): EffectsDocument | null {
  if (value == null) return null;
  const fields = object(value, "effects");
  const conditions = list(fields.conditions, "effects.conditions", limits.CONDITIONS).map((each, i) =>
    parseCondition(each, `effects.conditions[${i}]`),
  );
  const replan = wholes(fields.replan, "effects.replan", limits.EFFECT_ENTRIES, replans - 1);
  const condition = wholes(fields.condition, "effects.condition", limits.EFFECT_ENTRIES, conditions.length - 1);
  const places = replan.map((each, i) => each * conditions.length + condition[i]!);
  if (replan.length !== condition.length || places.some((place, i) => i > 0 && place <= places[i - 1]!)) {
    throw new StoreError("The store cannot be shown: the entries of effects are not in order, or name a replan and a condition twice.");
  }
  const units = list(fields.units, "effects.units", limits.AXIS).map((each, i) => finite(each, `effects.units[${i}]`));
  return { conditions, units, replan, condition };
}
