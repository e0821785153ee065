// Access to the page's elements by id, and small changes of them.

export const element = (name) => document.getElementById(name);
export const on = (name, event, does) => element(name).addEventListener(event, does);
export const press = (name, pressed) => element(name).setAttribute("aria-pressed", String(Boolean(pressed)));
export const put = (name, text) => {
  if (element(name).textContent !== text) element(name).textContent = text;
};

/** Mark one of a group of buttons as pressed, by a datum. */
export function pressOne(group, datum, value) {
  for (const button of element(group).querySelectorAll("button")) button.setAttribute("aria-pressed", String(button.dataset[datum] === value));
}

/** A slider with the part before its thumb filled. */
export function fill(slider, value) {
  slider.value = value;
  slider.style.setProperty("--done", `${(100 * (slider.value - slider.min)) / (slider.max - slider.min || 1)}%`);
}

let hiding;

/** Put the message into the open dialog, which covers the rest of the page, or back. */
export function placeToast() {
  const parent = [...document.querySelectorAll("dialog[open]")].at(-1) ?? document.body;
  if (element("toast").parentElement !== parent) parent.append(element("toast"));
}

export function toast(text, milliseconds = 2600) {
  placeToast();
  put("toast", text);
  element("toast").hidden = false;
  clearTimeout(hiding);
  hiding = setTimeout(() => (element("toast").hidden = true), milliseconds);
}

/** Show a message in place of the image, with a progress bar for a `fraction` in [0, 1]. */
export function notify(text, fraction) {
  element("notice").hidden = text === "";
  element("notice-text").textContent = text;
  element("notice-bar").hidden = fraction === undefined;
  element("notice-bar").value = fraction ?? 0;
  element("notice-open").hidden = true;
}

/** What the browser keeps under a name; null where storage is not allowed, as in some frames. */
export function recall(name) {
  try {
    return localStorage.getItem(name);
  } catch {
    return null;
  }
}

/** Keep a text, or forget it if it is null; whether that was possible. If not, no earlier text is kept either. */
export function remember(name, value) {
  try {
    if (value === null) localStorage.removeItem(name);
    else localStorage.setItem(name, value);
    return true;
  } catch {
    if (value !== null) remember(name, null);
    return false; // not allowed, or full
  }
}
