// Keys of shortcuts, on any keyboard layout.

const BRACKETS = { BracketLeft: "[", BracketRight: "]" };

// No handler gets keys with which an input method composes a text, such as the Enter that ends it.
addEventListener("keydown", (event) => { if (event.isComposing || event.keyCode === 229) event.stopImmediatePropagation(); }, true);

// Return the lower-case letter or the name of a key. For letters that aren't Latin, the place of the key counts.
export function keyOf({ key, code }) {
  if (key.length > 1) return key;
  return (key > "\u024f" && (/^Key([A-Z])$/.exec(code)?.[1] ?? BRACKETS[code]) || key).toLowerCase();
}

// Return whether a key is a command of the browser, not a shortcut. German, French and Nordic layouts have brackets with Option
// or AltGr, which is Ctrl and Alt on Windows.
export const isCommand = ({ key, altKey, ctrlKey, metaKey }) => metaKey || (altKey ? !/^[[\]]$/.test(key) : ctrlKey);

// Return "undo", "redo" or "".
export function historyOf(event) {
  if (!(event.ctrlKey || event.metaKey) || event.altKey) return "";
  return { z: event.shiftKey ? "redo" : "undo", y: "redo" }[keyOf(event)] ?? "";
}
