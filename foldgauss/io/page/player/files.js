// Opening models and scripts, and saving the edit: downloads, and the disk if the page comes from `foldgauss view`.
import { element, on, put, toast } from "./elements.js";
import { fingerprintOf } from "./gaussians.js";
import { Decoder, UNFINISHED } from "./loading.js";
import { writeSafetensors } from "./safetensors.js";
import { readScript, writeScript } from "./script.js";
import { Segments } from "./segments.js";
import { openDialog } from "./shell.js";
import { bytesOf } from "./sources.js";
import { withoutUnseen } from "./state.js";
import { Storage } from "./storage.js";

const LONG = 8000; // milliseconds that a problem is shown
const NO_SCRIPT = "none"; // the version where there is no script on the disk

/** Offer a file for download. */
export function download(content, name) {
  const link = document.createElement("a"), url = URL.createObjectURL(content);
  [link.href, link.download] = [url, name];
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}

export class Files {
  /** `show(segments, title)` opens a model that was decoded; `onProgress(text, fraction)` tells how far that is. */
  constructor(player, show, onProgress) {
    Object.assign(this, { player, show, onProgress });
    this.server = JSON.parse(element("server")?.textContent ?? "null");
    this.storage = new Storage((error) => toast(`The edit that the browser kept is discarded: ${error.message}`, LONG), () => toast("The browser does not keep this edit, nor its earlier state: it is too large, or storage is not allowed here. Download the script.", LONG));
    on("files-open", "click", () => openDialog("files"));
    for (const name of ["open-file", "notice-open"]) on(name, "click", () => this.choose());
    on("chooser", "change", () => this.open(element("chooser").files[0]));
    on("download-script", "click", () => this.downloadScript());
    on("download-model", "click", () => this.downloadModel());
    on("save-disk", "click", () => this.saveToDisk());
    on("start-afresh", "click", () => this.discard());
    this.bindDrop();
  }

  bindDrop() {
    const drop = element("drop"), hasFiles = (event) => event.dataTransfer?.types.includes("Files");
    document.addEventListener("dragover", (event) => {
      if (!hasFiles(event)) return;
      event.preventDefault();
      drop.hidden = false;
    });
    document.addEventListener("dragleave", (event) => event.relatedTarget ?? (drop.hidden = true));
    document.addEventListener("drop", (event) => {
      if (!hasFiles(event)) return;
      event.preventDefault();
      drop.hidden = true;
      this.open(event.dataTransfer.files[0]);
    });
  }

  choose() {
    element("chooser").value = "";
    element("chooser").click();
  }

  /** Describe a model that was opened, and once all of it has arrived take up its edit where it was left. */
  attach(title) {
    this.title = title;
    const { player, server } = this, { editing, segments } = player, { isWhole, arrived: { lost, chunks } } = segments.decoder;
    for (const one of document.querySelectorAll(".with-edit")) one.hidden = !isWhole;
    if (!isWhole) return;
    const { history } = editing, changed = history.onChange;
    history.onChange = () => {
      this.storage.changed();
      changed();
    };
    element("save-disk").hidden = element("save-about").hidden = !server || !this.isOfPage;
    const objects = this.isOfPage && element("objects") ? JSON.parse(element("objects").textContent) : {};
    element("select-objects").replaceChildren(...Object.entries(objects).map(([name, select]) => {
      const button = Object.assign(document.createElement("button"), { type: "button", textContent: `Select ${name}` });
      button.onclick = () => history.push({ select });
      return button;
    }));
    if (server) put("save-about", `As ${server.script}`);
    element("download-model").disabled = segments.spans.length > 1;
    this.storage.version = server && this.isOfPage ? element("script")?.dataset.version ?? NO_SCRIPT : undefined;
    const { canUndo, isCurrent } = this.storage.attach(`${fingerprintOf(player.base)}-${segments.total}-${segments.spans.length}`, history, (steps) => editing.check(steps, segments.held));
    if (canUndo) toast("The edit is as you left it.");
    if (this.isOfPage && element("script")) this.readFromDisk(canUndo && isCurrent);
    if (lost) toast(`${lost} of its ${chunks} chunks ${lost > 1 ? "are" : "is"} damaged or missing, and the rest is shown. Copy the file again.`, LONG);
  }

  /**
   * Take up the script beside the model, unless the edit that the browser kept began with it (`isKnown`); one that the
   * page cannot do must not be replaced.
   */
  readFromDisk(isKnown) {
    const { script } = this.server;
    try {
      const text = new TextDecoder("utf-8", { fatal: true }).decode(bytesOf(element("script").textContent));
      const steps = readScript(text, this.player.segments.counts);
      if (isKnown) return this.player.editing.check([{ script: steps }], this.player.segments.held);
      this.player.editing.load(steps, this.player.segments.held);
      toast(`${script} is applied. Undo takes it back.`);
    } catch (error) {
      toast(`${script}: ${error.message}`, LONG);
      element("save-disk").disabled = true;
      put("save-about", `${script} has edits that the page cannot do, and is left alone. Rename it to save another.`);
    }
  }

  /** Open a file: a script for this model, or a model. */
  async open(file) {
    if (!file) return;
    element("files").close();
    if (/\.toml$/i.test(file.name)) return this.readScript(await file.text(), file.name);
    await this.openModel(file, file.name);
  }

  async openModel(data, name, given) {
    const decoder = new Decoder([{ data, given }]);
    try {
      this.onProgress(`Opening ${name}`, 0);
      const model = await decoder.decode(0, (fraction) => this.onProgress(`Opening ${name}`, fraction));
      this.isOfPage = false;
      this.show(new Segments(model, null, decoder), name.replace(/\.\w+$/, ""));
      if (model.header.about) toast(model.header.about, LONG);
    } catch (error) {
      if (error.missing) return this.askFacts(data, name);
      this.onProgress("");
      toast(`${name}: ${error.message}`, LONG);
    }
  }

  /** Ask for the size and the rate that a file lacks. */
  askFacts(data, name) {
    this.onProgress("");
    openDialog("facts-needed");
    element("facts-needed").onclose = () => {
      if (element("facts-needed").returnValue !== "open") return;
      const [width, height, fps] = ["width", "height", "fps"].map((own) => Number(element(`needed-${own}`).value));
      this.openModel(data, name, { size: [height, width], fps });
    };
  }

  /** Apply a script; whether that was possible. */
  readScript(text, name) {
    const { player } = this;
    if (!player.segments?.decoder.isWhole) {
      toast(player.segments ? UNFINISHED : "Open the model first, then its script.", LONG);
      return false;
    }
    try {
      player.editing.load(readScript(text, player.segments.counts), player.segments.held);
      toast(`${name} is applied. Undo takes it back.`);
      return true;
    } catch (error) {
      toast(`${name}: ${error.message}`, LONG);
      return false;
    }
  }

  /** What the names of downloads begin with: beside `foldgauss view` that of the model's file, else the title. */
  get stem() {
    return this.server && this.isOfPage ? this.server.script.replace(/\.edit\.toml$/, "") : this.title;
  }

  get script() {
    const { editing, segments } = this.player;
    return writeScript(editing.history.current, segments.counts, this.title);
  }

  /** To the disk if there is a way, else as a download. */
  save() {
    if (!this.player.segments.decoder.isWhole) return toast(UNFINISHED, LONG);
    if (this.server && this.isOfPage && !element("save-disk").disabled) return this.saveToDisk();
    return this.downloadScript();
  }

  downloadScript() {
    download(new Blob([this.script], { type: "application/toml" }), `${this.stem}.edit.toml`);
  }

  downloadModel() {
    const { player: { state, base }, title, stem } = this;
    try {
      const kept = Object.entries(base.header.metadata ?? {}).filter(([name]) => ["frames", "frame_seconds", "first_second"].includes(name));
      const metadata = { clip: title, edited: "foldgauss player", ...Object.fromEntries(kept) };
      download(writeSafetensors(withoutUnseen(state).model, metadata), `${stem}.edited.safetensors`);
    } catch (error) {
      toast(error.message, LONG);
    }
  }

  /** Save after any saving under way, whose version this one replaces. */
  saveToDisk() {
    return (this.saving = Promise.resolve(this.saving).then(() => this.replaceScript()));
  }

  async replaceScript() {
    const { token, script } = this.server;
    try {
      const headers = { "X-Foldgauss-Token": token, "If-Match": `"${this.storage.version}"` };
      const answer = await fetch("/script", { method: "PUT", headers, body: this.script });
      if (answer.status === 412) return toast(`Not saved: ${await answer.text()}`, LONG);
      if (!answer.ok) throw new Error((await answer.text()).trim() || `the server answers ${answer.status}`);
      this.storage.version = answer.headers.get("ETag").replaceAll('"', "");
      this.storage.changed();
      toast(`Saved as ${script}`);
    } catch (error) {
      toast(`Not saved: ${error.message}. If foldgauss view has ended, download the script.`, LONG);
    }
  }

  discard() {
    this.player.editing.load([], this.player.segments.held);
    element("files").close();
    toast("The edit is discarded. Undo brings it back.");
  }
}
