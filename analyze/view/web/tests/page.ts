/** What a browser gives to the page's modules, as far as they ask for it when they are loaded. */
export function pretend(hash = ""): { location: { hash: string }; history: string[] } {
  const history: string[] = [];
  const location = { hash, pathname: "/", search: "", href: `http://page/${hash}` };
  const listeners = new Map<string, () => void>();
  const replaceState = (_: unknown, __: string, link: string): void => {
    location.hash = link.startsWith("#") ? link : "";
  };
  Object.assign(globalThis, {
    location,
    document: { getElementById: () => null },
    addEventListener: (kind: string, act: () => void) => listeners.set(kind, act),
    history: { replaceState, pushState: (_: unknown, __: string, link: string) => history.push(link) },
    fetch: () => Promise.reject(new Error("nobody answers")),
  });
  return { location, history };
}
