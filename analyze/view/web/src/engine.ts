/**
 * The grouping language and the measures, for tests: the page exports them, so that node can run what ships with the
 * cases on which Python decides (tests/analyze/view/test_grouping_parity.py, test_group_edits.py).
 */
export * from "./grouping/builtin_groupings";
export * from "./grouping/grouping";
export * from "./grouping/grouping_files";
export * from "./grouping/key_counts";
export * from "./grouping/resolve";
export * from "./grouping/selector_parser";
export * from "./grouping/text";
export * from "./grouping/tokens";
export * from "./grouping/words";
export * from "./groups/draft";
export * from "./groups/rectangles";
export * from "./groups/selector_edit";
export * from "./measures/masses";
export * from "./measures/picture_map";
export * from "./measures/ranks";
export * from "./measures/replans";
export * from "./measures/segments";
