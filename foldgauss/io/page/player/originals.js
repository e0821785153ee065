// The original's frames: pictures in the page's data blocks, decoded when they are wanted.
import { blockOf } from "./loading.js";

const KEPT = 24, AHEAD = 4;

export class Originals {
  /** `onReady` is called when a frame that was missing has come. */
  constructor(onReady) {
    this.num = document.querySelectorAll('script[id^="frame-"]').length;
    this.pictures = new Map(); // in the order of their last use
    this.coming = new Set();
    this.onReady = onReady;
  }

  /** Frame k, or while it is decoded the one that was shown last; null at first. */
  at(k) {
    for (let next = k; next <= k + AHEAD; next++) this.fetch(next % this.num);
    const picture = this.pictures.get(k);
    if (picture) {
      this.pictures.delete(k);
      this.pictures.set(k, picture);
      this.last = picture;
    }
    return picture ?? this.last ?? null;
  }

  async fetch(k) {
    if (this.pictures.has(k) || this.coming.has(k)) return;
    this.coming.add(k);
    const data = new Blob([blockOf(`frame-${k}`)], { type: "image/webp" });
    const picture = await createImageBitmap(data, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
    this.coming.delete(k);
    this.pictures.set(k, picture);
    for (const [old, own] of this.pictures) {
      if (this.pictures.size <= KEPT) break;
      if (own === this.last) continue;
      this.pictures.delete(old);
      own.close();
    }
    this.onReady();
  }
}
