/** The actions of this call, and beside them those of the call without what was taken away. */
import { address, type Grid, type NumberArray, readArray } from "./answers";
import { described, taken } from "./effects";
import { about, answered, beside, besideReplan, episodeName, part, replan, runNumber } from "./state";
import { range } from "./sums";

const NAMES = ["x", "y", "z", "turn x", "turn y", "turn z", "gripper"];

const changed = answered<NumberArray>(
  () => taken.value && readArray(`${address.episode(runNumber.value, episodeName.value)}/actions/${taken.value.number}.npy`),
);

function chunkAt({ shape, data }: NumberArray, at: number): number[][] {
  const [steps, size] = [shape[1]!, shape[2]!];
  return range(steps).map((step) => Array.from(data.subarray((at * steps + step) * size, (at * steps + step + 1) * size)));
}

function path(values: readonly (number | null | undefined)[], low: number, high: number): string {
  const points = values.map((one, i) =>
    one == null || Number.isNaN(one)
      ? null
      : `${((100 * i) / Math.max(1, values.length - 1)).toFixed(1)} ${(38 - (36 * (one - low)) / (high - low)).toFixed(1)}`,
  );
  return points.reduce<string>(
    (text, point, i) => (point === null ? text : `${text}${i && points[i - 1] !== null ? "L" : "M"}${point}`),
    "",
  );
}

export function Actions() {
  const chunk: Grid | undefined = about.value.value?.actions?.[replan.value];
  if (!chunk?.length) return null;
  const size = chunk[0]!.length;
  const besides = part("beside") ? beside.about.value.value?.actions?.[besideReplan.value] : undefined;
  const other: Grid | null = besides ?? (changed.value.value ? chunkAt(changed.value.value, replan.value) : null);
  const whose = besides ? "the episode beside it" : taken.value && described(taken.value);
  const all = [...chunk.flat(), ...(other ?? []).flat()].filter((one): one is number => typeof one === "number" && Number.isFinite(one));
  const most = Math.max(1e-6, ...all.map(Math.abs));
  return (
    <section class="actions" aria-label="Actions of this call">
      <h2>Actions of this call</h2>
      <p class="soft">
        {chunk.length} steps, scale ±{Number(most.toPrecision(2))}
        {other ? (
          <>
            ; <span class="without">dashed: {whose}</span>
          </>
        ) : part("without") && about.value.value?.effects ? (
          `; ${part("without")} was not recorded at this call`
        ) : (
          ""
        )}
      </p>
      <div class="small-plots">
        {range(size).map((i) => (
          <figure key={i}>
            <svg viewBox="0 0 100 40" preserveAspectRatio="none" role="img" aria-label={size === 7 ? NAMES[i] : `dimension ${i}`}>
              <path class="zero" d="M0 20H100" />
              <path
                class="chunk"
                d={path(
                  chunk.map((line) => line[i]),
                  -most,
                  most,
                )}
              />
              {other ? (
                <path
                  class="chunk without"
                  d={path(
                    other.map((line) => line[i]),
                    -most,
                    most,
                  )}
                />
              ) : null}
            </svg>
            <figcaption>{size === 7 ? NAMES[i] : i}</figcaption>
          </figure>
        ))}
      </div>
    </section>
  );
}
