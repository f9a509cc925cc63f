/** Dark or light: as the system says, or as somebody chose here. */
import { button, element } from "./dom";

const THEMES = ["auto", "light", "dark"] as const;
type Theme = (typeof THEMES)[number];
const NAMES: Readonly<Record<Theme, string>> = { auto: "as the system", light: "light", dark: "dark" };
const SIGNS: Readonly<Record<Theme, string>> = { auto: "◐", light: "☀", dark: "☾" };
const KEPT = "vla-attention-theme";

function keptTheme(): Theme {
  try {
    return THEMES.find((theme) => theme === localStorage.getItem(KEPT)) ?? "auto";
  } catch {
    return "auto";
  }
}

/** A button that goes through the themes. */
export function themeButton(): HTMLButtonElement {
  let theme = keptTheme();
  const apply = (): void => {
    if (theme === "auto") delete document.documentElement.dataset.theme;
    else document.documentElement.dataset.theme = theme;
    made.replaceChildren(SIGNS[theme], element("span", { class: "if-wide" }, ` ${NAMES[theme]}`));
    made.setAttribute("aria-label", `Colours of the page: ${NAMES[theme]}. Press for the next.`);
  };
  const made = button("", () => {
    theme = THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length]!;
    try {
      localStorage.setItem(KEPT, theme);
    } catch {
      // A browser that keeps nothing: the theme holds until the page is closed.
    }
    apply();
  }, { class: "theme" });
  apply();
  return made;
}
