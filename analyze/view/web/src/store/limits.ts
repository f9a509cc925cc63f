/** How much a store may ask for; the same numbers as schemas/limits.py, which gives the reason for each. */
export const DOCUMENT_BYTES = 32_000_000;
export const ROOT_BYTES = 4_000_000;
export const NESTING = 64;
export const NAME_CHARACTERS = 255;
export const TEXT_CHARACTERS = 100_000;
export const KEYS = 2 ** 20;
export const SPANS = 1000;
export const SITES = 64;
export const AXIS = 10_000;
export const QUERIES = 100_000;
export const REPLANS = 1_000_000;
export const PICTURE_SIDE = 8192;
export const PICTURE_PIXELS = 10_000_000;
export const CLAIMED_BYTES = 64_000_000;
export const ARRAY_AXES = 8;
export const CONDITIONS = 10_000;
export const EFFECT_ENTRIES = 1_000_000;
export const BODIES = 10_000;
export const GOALS = 10_000;

/** Bytes of one array that the page holds at once: a browser has less memory than the commands. */
export const ARRAY_IN_PAGE_BYTES = 256_000_000;
/** Prompts, objects and segments of an episode: what a page can list. */
export const LISTED = 100_000;
