// The original's frames, in the page's data blocks, decoded on demand.
import { bytesOf } from "./sources.js";

const KEPT = 24, AHEAD = 4;

export class Originals {
  /** Of blocks with the frames as WebP, in base64; `onReady` is called when a missing frame has been decoded. */
  constructor(blocks, onReady) {
    this.blocks = blocks;
    this.num = blocks.length;
    this.images = new Map(); // least recently used first
    this.coming = new Set();
    this.onReady = onReady;
  }

  /** Frame k, or the last one shown while it is being decoded; null at first. */
  at(k) {
    for (let next = k; next <= k + AHEAD; next++) this.fetch(next % this.num);
    const image = this.images.get(k);
    if (image) {
      this.images.delete(k);
      this.images.set(k, image);
      this.last = image;
    }
    return image ?? this.last ?? null;
  }

  async fetch(k) {
    if (this.images.has(k) || this.coming.has(k)) return;
    this.coming.add(k);
    const data = new Blob([bytesOf(this.blocks[k].textContent)], { type: "image/webp" });
    const image = await createImageBitmap(data, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
    this.coming.delete(k);
    this.images.set(k, image);
    for (const [old, own] of this.images) {
      if (this.images.size <= KEPT) break;
      if (own === this.last) continue;
      this.images.delete(old);
      own.close();
    }
    this.onReady();
  }
}
