/** Elements without a framework. What a store says becomes text, never markup. */

type Child = Node | string | null | undefined;
type Attributes = Readonly<Record<string, string | number | boolean | null | undefined>>;

function fill<T extends Element>(made: T, attributes: Attributes, children: readonly Child[]): T {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    made.setAttribute(name, value === true ? "" : String(value));
  }
  made.append(...children.filter((child): child is Node | string => child !== null && child !== undefined));
  return made;
}

/** An HTML element with attributes and children. */
export function element<K extends keyof HTMLElementTagNameMap>(
  tag: K,
  attributes: Attributes = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  return fill(document.createElement(tag), attributes, children);
}

/** An SVG element with attributes and children. */
export function svg<K extends keyof SVGElementTagNameMap>(
  tag: K,
  attributes: Attributes = {},
  ...children: Child[]
): SVGElementTagNameMap[K] {
  return fill(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
}

/** A button that does something. */
export function button(label: string, act: () => void, attributes: Attributes = {}): HTMLButtonElement {
  const made = element("button", { type: "button", ...attributes }, label);
  made.addEventListener("click", act);
  return made;
}

/** A labelled choice; `choose` is called with the chosen value. */
export function choice(label: string, name: string, choose: (value: string) => void): {
  host: HTMLLabelElement;
  show(options: readonly (readonly [value: string, text: string])[], value: string): void;
} {
  const select = element("select", { name });
  select.addEventListener("change", () => choose(select.value));
  let last = "";
  return {
    host: element("label", { class: "choice" }, element("span", {}, label), select),
    show(options, value) {
      const now = JSON.stringify(options);
      if (now !== last) {
        select.replaceChildren(...options.map(([of, text]) => element("option", { value: of }, text)));
        last = now;
      }
      select.value = value;
      select.disabled = options.length < 2;
    },
  };
}
