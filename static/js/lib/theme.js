// Light or dark: as the system says, until a person chooses. `js/theme-first.js` applies the choice before first paint.

const KEY = "rooftrack-theme";

const isDark = () => {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : window.matchMedia("(prefers-color-scheme: dark)").matches;
};

/** @type {Set<() => void>} */
const listeners = new Set();

/** For what is drawn on a canvas and cannot follow the style sheet. @param {() => void} listener */
export const onTheme = (listener) => listeners.add(listener);

window
  .matchMedia("(prefers-color-scheme: dark)")
  .addEventListener("change", () => listeners.forEach((listener) => listener()));

export function nextTheme() {
  const theme = isDark() ? "light" : "dark";
  document.documentElement.dataset.theme = theme;
  localStorage.setItem(KEY, theme);
  listeners.forEach((listener) => listener());
}

/** @returns {"sun" | "moon"} */
export const themeIcon = () => (isDark() ? "sun" : "moon");
