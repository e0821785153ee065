// The part of TOML that edit scripts are written in: tables, arrays of tables, bare and quoted keys; strings on one line,
// numbers, booleans and arrays. Anything else is refused with its line.

class Reader {
  constructor(text) {
    this.text = text.replace(/^\uFEFF/, "").replace(/\r\n/g, "\n");
    this.at = 0;
  }

  get line() {
    return this.text.slice(0, this.at).split("\n").length;
  }

  fail(expected) {
    const got = this.text.slice(this.at, this.at + 24).split("\n")[0] || "the line's end";
    throw new Error(`line ${this.line}: expected ${expected}, got ${JSON.stringify(got)}.`);
  }

  /** Skip what matches, and return it. */
  take(pattern) {
    const sticky = new RegExp(pattern, "y");
    sticky.lastIndex = this.at;
    const found = sticky.exec(this.text);
    if (found) this.at += found[0].length;
    return found;
  }

  expect(pattern, what) {
    return this.take(pattern) ?? this.fail(what);
  }

  /** Blanks, comments and, in arrays and between lines, line ends. */
  blank() {
    this.take(/(?:[ \t\n]|#[^\n]*)*/);
  }

  endOfLine() {
    this.expect(/[ \t]*(?:#[^\n]*)?(?:\n|$)/, "the line's end");
  }

  key() {
    const parts = [];
    do {
      this.take(/[ \t]*/);
      const bare = this.take(/[A-Za-z0-9_-]+/);
      parts.push(bare ? bare[0] : this.string());
      this.take(/[ \t]*/);
    } while (this.take(/\./));
    return parts;
  }

  string() {
    const literal = this.take(/'([^'\n]*)'/);
    if (literal) return literal[1];
    const found = this.expect(/"(?:[^"\\\n]|\\[^\n])*"/, "a key or a value")[0];
    try {
      return JSON.parse(found.replace(/\\U([0-9A-Fa-f]{8})/g, (whole, code) => String.fromCodePoint(parseInt(code, 16))));
    } catch {
      return this.fail("a text with the escapes of TOML");
    }
  }

  value() {
    if (this.take(/\[/)) {
      const list = [];
      for (this.blank(); !this.take(/\]/); this.blank()) {
        list.push(this.value());
        this.blank();
        if (!this.take(/,/)) {
          this.expect(/\]/, "a comma or ]");
          break;
        }
      }
      return list;
    }
    const word = this.take(/(?:true|false)\b/);
    if (word) return word[0] === "true";
    const number = this.take(/[+-]?\d[\d_]*(?:\.\d[\d_]*)?(?:[eE][+-]?\d[\d_]*)?(?![\w.:])/);
    return number ? Number(number[0].replaceAll("_", "")) : this.string();
  }
}

/** The tables of a text, with the `line` of each beginning under the symbol LINE. Throws an Error for display. */
export const LINE = Symbol("line");

export function parseToml(text) {
  const reader = new Reader(text), root = table(0);
  let current = root;
  for (reader.blank(); reader.at < reader.text.length; reader.blank()) {
    const { line } = reader, many = reader.take(/\[\[/);
    if (many || reader.take(/\[/)) {
      const path = reader.key();
      reader.expect(many ? /\]\]/ : /\]/, many ? "]]" : "]");
      current = descend(root, path, Boolean(many), line);
    } else {
      const path = reader.key(), name = path.pop();
      reader.expect(/=[ \t]*/, "=");
      const owner = path.reduce((own, key) => (own[key] ??= table(line)), current);
      if (name in owner) throw new Error(`line ${line}: expected each key once, got ${JSON.stringify(name)} again.`);
      owner[name] = reader.value();
    }
    reader.endOfLine();
  }
  return root;
}

function table(line) {
  const made = Object.create(null); // no names but those of the file
  made[LINE] = line;
  return made;
}

function descend(root, path, many, line) {
  let current = root;
  path.forEach((key, k) => {
    const last = k === path.length - 1;
    if (last && many) (current[key] ??= []).push(table(line));
    else if (last && key in current && !Array.isArray(current[key]) && !Object.keys(current[key]).length) current[key][LINE] = line;
    else if (last && key in current) throw new Error(`line ${line}: expected each table once, got ${JSON.stringify(path.join("."))} again.`);
    else current[key] ??= table(line);
    current = Array.isArray(current[key]) ? current[key].at(-1) : current[key];
    if (typeof current !== "object") throw new Error(`line ${line}: expected a table, got a value named ${JSON.stringify(key)} before.`);
  });
  return current;
}
