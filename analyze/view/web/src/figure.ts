/** The pictures of a call as a figure of its own, drawn from what is shown and not from how a browser shows it. */
import { address, readPicture } from "./answers";
import { capOf, isDrawn, type Kind, levels, linesOf, meaning, STROKES, sampleOf } from "./pictures";
import { denoise, fullNameOf, head, layer, main, type Side, sides, site } from "./state";

/** Pixels: the width of a picture, between things, of a line of text, and of a letter of it, about. */
const [PICTURE, GAP, LINE, LETTER] = [320, 12, 18, 6.9];

export const escaped = (text: string): string => text.replace(/[&<>"]/g, (letter) => `&#${letter.charCodeAt(0)};`);

/** Words in lines of so many pixels. */
export function wrapped(text: string, width: number): string[] {
  const [most, lines] = [Math.max(10, Math.floor(width / LETTER)), [""]];
  for (const word of text.split(" ")) {
    const last = lines[lines.length - 1]!;
    if (last && last.length + 1 + word.length > most) lines.push(word);
    else lines[lines.length - 1] = last ? `${last} ${word}` : word;
  }
  return lines;
}

const written = (text: string, x: number, y: number, bold = false): string =>
  `<text x="${x}" y="${y}" font-family="DejaVu Sans, Verdana, sans-serif" font-size="12"${bold ? ' font-weight="bold"' : ""}>${escaped(text)}</text>`;

const strokes = (kind: Kind, path: string): string =>
  STROKES[kind]
    .map(
      ([stroke, width, dash]) =>
        `<path d="${path}" fill="none" stroke="${stroke}" stroke-linecap="${capOf(kind)}" stroke-width="${width}"${dash ? ` stroke-dasharray="${dash}"` : ""}/>`,
    )
    .join("");

async function asData(from: string): Promise<string> {
  const image = new Image();
  image.src = from;
  await image.decode();
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
  canvas.getContext("2d")!.drawImage(image, 0, 0);
  return canvas.toDataURL("image/png");
}

interface Drawn {
  readonly text: string;
  readonly width: number;
  readonly height: number;
}

/** One episode: whose it is, what it came to, the step, and its pictures with their lines. */
async function drawnSide(side: Side): Promise<Drawn> {
  const { scene, at } = side;
  const episode = scene.about.value.value!;
  const cameras = Object.entries(scene.layout.value?.cameras ?? {});
  const width = Math.max(PICTURE, cameras.length * (PICTURE + GAP) - GAP);
  const heads = [
    ...wrapped(fullNameOf(side), 0.9 * width).map((line) => [line, true] as const),
    ...wrapped(episode.verdict, width).map((line) => [line, false] as const),
    [`step ${episode.starts[at]} of ${episode.end}, call ${at} (0 to ${episode.starts.length - 1})`, false] as const,
  ];
  const texts = heads.map(([line, bold], i) => written(line, 0, (i + 1) * LINE - 4, bold));
  const top = heads.length * LINE + 4;
  let high = 0;
  const pictures = await Promise.all(
    cameras.map(async ([camera, how], i) => {
      const tall = Math.round((PICTURE * how.height) / how.width);
      high = Math.max(high, tall);
      const cell = [PICTURE / how.columns, tall / how.rows] as const;
      const lines = linesOf({ scene, camera, how, at }).map(({ kind, path }) => strokes(kind, path(cell)));
      const below = how.stored
        ? `<image width="${PICTURE}" height="${tall}" preserveAspectRatio="none" href="${await asData(await readPicture(address.picture(scene.run.value, scene.name.value, camera, at)))}"/>`
        : `<rect width="${PICTURE}" height="${tall}" fill="#cdcdcd"/>`;
      return `<g transform="translate(${i * (PICTURE + GAP)} ${top})">${below}${lines.join("")}${written(camera, 0, tall + LINE - 4)}</g>`;
    }),
  );
  return { text: texts.join("") + pictures.join(""), width, height: top + high + LINE };
}

/** All that is shown of a call, with the key of its lines and what was chosen, as an SVG that needs no other file. */
export async function figure(): Promise<Drawn> {
  const each = await Promise.all(sides.value.map(drawnSide));
  let x = GAP;
  const parts = each.map(({ text, width }) => {
    const part = `<g transform="translate(${x} ${GAP})">${text}</g>`;
    x += width + 2 * GAP;
    return part;
  });
  const width = x - GAP;
  let y = GAP + Math.max(...each.map(({ height }) => height)) + LINE;
  let at = GAP;
  for (const kind of (Object.keys(STROKES) as Kind[]).filter(meaning)) {
    const room = 40 + LETTER * meaning(kind).length;
    if (at > GAP && at + room > width) [at, y] = [GAP, y + LINE];
    parts.push(
      `<rect x="${at}" y="${y - 9}" width="24" height="9" fill="#8a8f96"/>`,
      strokes(kind, sampleOf(kind, at + 2, y - 4.5)),
      written(meaning(kind), at + 30, y),
    );
    at += room;
  }
  const chosen = [
    ["site", site.value],
    ["layer", layer.value],
    ["head", head.value],
    ["denoise step", denoise.value],
  ].map(([name, one]) => (one === "mean" ? `mean of ${name}s` : `${name} ${one}`));
  const settings = `Attention of the action queries: ${chosen.join(", ")}.${isDrawn(main, "read") ? ` Lines go around patches that get ${levels.value.join(" and ")} times what an even spread would give.` : ""}${meaning("moves") ? " Blue lines: how far the action changes without a patch, by first order, on a scale of its own." : ""}`;
  for (const line of wrapped(settings, width - 2 * GAP)) {
    y += LINE;
    parts.push(written(line, GAP, y));
  }
  const height = y + GAP;
  return {
    text: `<svg xmlns="http://www.w3.org/2000/svg" width="${width}" height="${height}" viewBox="0 0 ${width} ${height}"><rect width="${width}" height="${height}" fill="#fff"/>${parts.join("")}</svg>`,
    width,
    height,
  };
}
