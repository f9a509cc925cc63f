/**
 * What the page reads and computes of a store, for tests: the page exports it, so that node can run what ships
 * (tests/analyze/view/test_page_numbers.py).
 */
export { headsThatRead, objectsAt } from "./page/inspector";
export { colourTable } from "./page/colour_maps";
export { overlayPixels, patchAt, placeOfPatch, scaleFor, shownValues, viewOf } from "./page/overlay";
export { decidingWord, itemsOfWords, wordEffect } from "./page/effect_words";
export { happenings } from "./store/steps_document";
export { effectsOf } from "./page/effects_shown";
export { closingReplan, eventsOf } from "./page/events";
export { found } from "./page/episode_list";
export { patchesBetween } from "./page/patch_outlines";
export { loadShown } from "./page/shown";
export { linkOfState, stateOfLink } from "./page/state";
export { measuresOfKeys } from "./page/word_strip";
export { executedSteps, sizesOf } from "./measures/effects";
export { inProcessPort, Library } from "./store/in_process";
