// Translates GLSL to WGSL, for shaders that keep these rules: only sums and products mix vectors and scalars, shifts are by
// unsigned numbers, constructors convert whole vectors, and no function is overloaded.

const BINARY = [["||"], ["&&"], ["|"], ["^"], ["&"], ["==", "!="], ["<", ">", "<=", ">="], ["<<", ">>"], ["+", "-"], ["*", "/", "%"]];
const COMPARED = { lessThan: "<", greaterThan: ">", lessThanEqual: "<=", greaterThanEqual: ">=", equal: "==", notEqual: "!=" };
const CALLED = { dFdx: "dpdx", dFdy: "dpdy", packSnorm2x16: "pack2x16snorm", unpackSnorm2x16: "unpack2x16snorm", texelFetch: "textureLoad" };
const SCALARS = { "": "f32", i: "i32", u: "u32", b: "bool" };
const TYPES = { float: "f32", int: "i32", uint: "u32", bool: "bool", mat3: "mat3x3<f32>" };
for (const [letter, scalar] of Object.entries(SCALARS)) for (const size of [2, 3, 4]) TYPES[`${letter}vec${size}`] = `vec${size}<${scalar}>`;
const TOKEN = /[A-Za-z_]\w*|0x[\dA-F]+u?|\d+\.?\d*(?:e[+-]?\d+)?u?|<<|>>|[<>=!+\-*/%&|^]=|&&|\|\||\+\+|--|\S/g;

// Split the arguments in parentheses that begin at a place; returns them, and where they end.
function argumentsAt(text, begin) {
  const parts = [""];
  for (let at = begin, depth = 0; ; at++) {
    const each = text[at];
    if ("([".includes(each) && depth++ === 0) continue;
    if (")]".includes(each) && --depth === 0) return [parts, at + 1];
    if (each === "," && depth === 1) parts.push("");
    else parts[parts.length - 1] += each;
  }
}

// Expand macros, and drop the lines that conditions leave out.
export function preprocessed(text) {
  const macros = new Map(), isLive = [true]; // of each nested condition, whether its lines count
  const isDefined = (text) => {
    const [, not, name] = /(!?)\s*defined\((\w+)\)/.exec(text);
    return macros.has(name) !== Boolean(not);
  };
  const expanded = (line) => {
    const name = line.match(/\b[A-Z]\w*\b/g)?.find((each) => macros.has(each));
    if (!name) return line;
    const { parameters, body } = macros.get(name), begin = line.search(new RegExp(`\\b${name}\\b`));
    let end = begin + name.length, made = body;
    if (parameters) {
      const [texts, after] = argumentsAt(line, end), values = Object.fromEntries(parameters.map((each, n) => [each, texts[n].trim()]));
      made = body.replace(/\b\w+\b/g, (word) => values[word] ?? word);
      end = after;
    }
    return expanded(line.slice(0, begin) + made + line.slice(end));
  };
  const output = [];
  for (const line of text.replace(/\/\/.*$/gm, "").split("\n")) {
    const [, word, rest] = /^\s*#(\w+)\s*(.*)$/.exec(line) ?? [], counts = isLive.every(Boolean);
    if (word === "ifdef") isLive.push(macros.has(rest.trim()));
    else if (word === "ifndef") isLive.push(!macros.has(rest.trim()));
    else if (word === "if") isLive.push(rest.split("||").some((or) => or.split("&&").every(isDefined)));
    else if (word === "else") isLive.push(!isLive.pop());
    else if (word === "endif") isLive.pop();
    else if (counts && word === "define") {
      const [, name, listed, body] = /^(\w+)(?:\(([^)]*)\))?\s*(.*)$/.exec(rest);
      macros.set(name, { parameters: listed?.split(/,\s*/), body });
    } else if (counts) output.push(expanded(line));
  }
  return output.join("\n");
}

// Parses GLSL by recursive descent; each method returns the WGSL of what it parses.
class Translator {
  constructor(text) {
    this.tokens = text.match(TOKEN);
    this.at = 0;
    this.types = { ...TYPES };
    this.functions = {}; // by name: whether each parameter is an output
    this.pointers = []; // names of the current function's outputs
  }

  get next() {
    return this.tokens[this.at];
  }

  // Skip the next token if it is this one; returns whether it was.
  has(token) {
    if (this.next !== token) return false;
    this.at++;
    return true;
  }

  take(token = this.next) {
    if (!this.has(token)) throw new Error(`octex-three: ${token} is expected, not ${this.tokens.slice(this.at, this.at + 9).join(" ")}`);
    return token;
  }

  // Skip all up to a token.
  skipTo(end) {
    while (!this.has(end)) this.at++;
    return "";
  }

  type() {
    const name = this.take();
    if (!this.types[name]) throw new Error(`octex-three: there is no type ${name}`);
    return this.types[name];
  }

  top() {
    if (this.next === "precision") return this.skipTo(";");
    if (this.has("struct")) return this.struct();
    if (this.has("const")) return `${this.declared("const")};`;
    if (this.has("uniform")) {
      this.has("highp");
      return this.next.includes("sampler") ? this.skipTo(";") : `${this.declared("var<private>")};`;
    }
    return this.tokens[this.at + 2] === "(" ? this.function() : `${this.declared("var<private>")};`;
  }

  struct() {
    const name = this.take(), fields = [];
    this.types[name] = name;
    this.take("{");
    while (!this.has("}")) {
      const type = this.type();
      do fields.push(`${this.take()}: ${type}`);
      while (this.has(","));
      this.take(";");
    }
    this.take(";");
    return `struct ${name} { ${fields.join(", ")} }`;
  }

  // A type, or an array type if a size follows the name.
  sized(type) {
    if (!this.has("[")) return type;
    const size = this.expression();
    this.take("]");
    return `array<${type}, ${size}>`;
  }

  declared(kind) {
    const type = this.type(), made = [];
    do {
      const name = this.take(), whole = this.sized(type);
      made.push(`${kind} ${name}: ${whole}${this.has("=") ? ` = ${this.expression()}` : ""}`);
    } while (this.has(","));
    this.has(";");
    return made.join("; ");
  }

  function() {
    const result = this.has("void") ? "" : ` -> ${this.type()}`, name = this.take(), head = [], copies = [];
    const writes = (this.functions[name] = []);
    this.take("(");
    while (!this.has(")")) {
      const isWritten = this.has("inout") || this.has("out"), type = this.type(), parameter = this.take(), whole = this.sized(type);
      head.push(isWritten ? `${parameter}: ptr<function, ${whole}>` : `${parameter}_given: ${whole}`);
      if (isWritten) this.pointers.push(parameter);
      else copies.push(`var ${parameter} = ${parameter}_given;`);
      writes.push(isWritten);
      this.has(",");
    }
    const body = this.block();
    this.pointers = [];
    return `fn ${name}(${head.join(", ")})${result} { ${copies.join(" ")} ${body} }`;
  }

  // Statements in braces, or a single statement.
  block() {
    if (!this.has("{")) return this.statement();
    const made = [];
    while (!this.has("}")) made.push(this.statement());
    return made.join("\n");
  }

  statement() {
    if (this.next === "{") return `{ ${this.block()} }`;
    if (this.has(";")) return "";
    if (this.has("const")) return `${this.declared("let")};`;
    for (const word of ["break", "continue"]) if (this.has(word)) return `${word}${this.take(";")}`;
    if (this.has("return")) return this.has(";") ? "return;" : `return ${this.expression()}${this.take(";")}`;
    if (this.has("if")) {
      const made = `if ${this.condition()} { ${this.block()} }`;
      return this.has("else") ? `${made} else { ${this.block()} }` : made;
    }
    if (this.has("while")) return `while ${this.condition()} { ${this.block()} }`;
    if (this.has("for")) {
      this.take("(");
      const begin = this.has(";") ? "" : this.simple(), test = this.next === ";" ? "" : this.expression();
      this.take(";");
      const step = this.next === ")" ? "" : this.simple();
      this.take(")");
      return `for (${begin}; ${test}; ${step}) { ${this.block()} }`;
    }
    return `${this.simple()};`;
  }

  condition() {
    return `${this.take("(")}${this.expression()}${this.take(")")}`;
  }

  // Declarations, assignments and calls.
  simple() {
    if (this.types[this.next]) return this.declared("var");
    const made = [];
    do {
      const targets = [this.unary()];
      if (this.has("++") || this.has("--")) made.push(`${targets[0]}${this.tokens[this.at - 1]}`);
      else if (!/^([-+*/%&|^]|<<|>>)?=$/.test(this.next)) made.push(targets[0]);
      else {
        const operator = this.take();
        let value = this.expression();
        for (; this.has("="); value = this.expression()) targets.push(value);
        for (const target of targets.reverse()) [made[made.length], value] = [`${target} ${operator} ${value}`, target];
      }
    } while (this.has(","));
    this.has(";");
    return made.join("; ");
  }

  expression() {
    const condition = this.binary();
    if (!this.has("?")) return condition;
    const yes = this.expression();
    this.take(":");
    return `select(${this.expression()}, ${yes}, ${condition})`;
  }

  binary(level = 0) {
    if (level === BINARY.length) return this.unary();
    let left = this.binary(level + 1);
    while (BINARY[level].includes(this.next)) left = `(${left} ${this.take()} ${this.binary(level + 1)})`;
    return left;
  }

  unary() {
    if (["-", "!", "~"].includes(this.next)) return `${this.take()}${this.unary()}`;
    let made = this.primary();
    for (;;) {
      if (this.has(".")) made += `.${this.take()}`;
      else if (this.has("[")) made += `[${this.expression()}${this.take("]")}`;
      else return made;
    }
  }

  primary() {
    if (this.has("(")) return `(${this.expression()}${this.take(")")}`;
    const name = this.take();
    if (this.has("(")) return this.call(name);
    return this.pointers.includes(name) ? `(*${name})` : name;
  }

  call(name) {
    const given = [], writes = this.functions[name] ?? [];
    while (!this.has(")")) {
      given.push(writes[given.length] ? `&${this.expression()}` : this.expression());
      this.has(",");
    }
    if (COMPARED[name]) return `(${given.join(` ${COMPARED[name]} `)})`;
    // WGSL takes the layer of an array texture as an argument of its own.
    if (name === "texelFetch") given[1] = given[1].replace(/^vec3<i32>\((.*), (\d+)\)$/, "$1, $2");
    return `${this.types[name] ?? CALLED[name] ?? name}(${given.join(", ")})`;
  }
}

// Translate a shader. The caller declares the samplers; other uniforms become variables.
export function wgslOf(text) {
  const translator = new Translator(preprocessed(text)), made = [];
  while (translator.next) made.push(translator.top());
  return made.join("\n");
}
