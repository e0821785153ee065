// Selections as text: "3,17,40-52", as `indices` in edit scripts, rising, both ends of a range included.

export function toRanges(mask) {
  const parts = [];
  for (let i = 0; i < mask.length; i++) {
    if (!mask[i]) continue;
    const first = i;
    while (i + 1 < mask.length && mask[i + 1]) i++;
    parts.push(first === i ? `${i}` : `${first}-${i}`);
  }
  return parts.join(",");
}

/** The mask of `num` Gaussians that a text describes; throws an Error for display. */
export function fromRanges(text, num) {
  const mask = new Uint8Array(num);
  for (const part of text === "" ? [] : text.split(",")) {
    const found = /^\s*(\d{1,9})(?:-(\d{1,9}))?\s*$/.exec(part), first = Number(found?.[1]), last = Number(found?.[2] ?? first);
    if (!found || last < first) throw new Error(`indices: expected numbers and ranges, as "3,17,40-52", got ${JSON.stringify(part.slice(0, 40))}.`);
    if (last >= num) throw new Error(`indices: expected Gaussians from 0 to ${num - 1}, got ${last}. Is it another model's script?`);
    mask.fill(1, first, last + 1);
  }
  return mask;
}
