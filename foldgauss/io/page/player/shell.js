// What the page does without a model: light and dark, full screen, and the help.
import { element, on, placeToast, recall, remember, toast } from "./elements.js";

const THEME = "foldgauss-theme";

const show = (theme) => (document.documentElement.dataset.theme = theme);

export function toggleTheme() {
  show(document.documentElement.dataset.theme === "light" ? "dark" : "light");
  remember(THEME, document.documentElement.dataset.theme);
}

export function toggleFull() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen?.().catch(() => toast("Full screen is not allowed here."));
}

/** Show a dialog; its title has the focus, not a button, whose focus ring would distract. */
export function openDialog(name) {
  element(name).showModal();
  placeToast();
  element(element(name).getAttribute("aria-labelledby")).focus();
}

export const openHelp = () => openDialog("help");

export function bindShell() {
  const wished = matchMedia("(prefers-color-scheme: light)");
  show(recall(THEME) ?? (wished.matches ? "light" : "dark"));
  wished.addEventListener("change", () => recall(THEME) ?? show(wished.matches ? "light" : "dark"));
  element("full").hidden = !document.fullscreenEnabled;
  on("theme", "click", toggleTheme);
  on("full", "click", toggleFull);
  on("help-open", "click", openHelp);
  for (const name of ["help", "files"]) {
    on(`${name}-close`, "click", () => element(name).close());
    on(name, "click", (event) => event.target === element(name) && element(name).close());
  }
  for (const dialog of document.querySelectorAll("dialog")) dialog.addEventListener("close", placeToast);
}
