// Sends commands to the server in order, each again until the server has it. See octex/session/commands.py.

const FIRST_PAUSE = 300, MAX_PAUSE = 5000; // milliseconds before a command is sent again
const TARGETLESS = ["undo", "redo", "save", "layer", "take", "keep"]; // commands that paint nothing
const UNKNOWN_PAGE = 409, TEMPORARY = [429, 503, 507]; // HTTP statuses

export class CommandQueue {
  // `showMessage` is called with a problem, or "" when it is over; `changed` when a command is added; `target` returns the
  // layer to paint.
  constructor(showMessage, target, changed) {
    Object.assign(this, { showMessage, target, changed });
    this.restart();
    this.waiting = [];
  }

  // Begin a new numbering under a new name.
  restart() {
    this.page = crypto.randomUUID();
    this.number = 0;
  }

  // Send a command with its content (bytes, or a promise of them). Returns the queued command, whose number may change while
  // it waits.
  send(fields, content = new Uint8Array()) {
    const target = TARGETLESS.includes(fields.kind) ? {} : this.target(), command = { ...target, ...fields, number: ++this.number, content };
    this.waiting.push(command);
    this.running ||= this.run().finally(() => (this.running = null));
    this.changed();
    return command;
  }

  // Wait until all commands are sent.
  async flush() {
    while (this.running) await this.running;
  }

  async run() {
    let pause = FIRST_PAUSE;
    while (this.waiting.length) {
      const { content, ...fields } = this.waiting[0];
      const line = new TextEncoder().encode(`${JSON.stringify({ page: this.page, ...fields })}\n`);
      const response = await this.post(new Blob([line, await content]));
      if (response?.ok) {
        this.waiting.shift();
        this.showMessage("");
        pause = FIRST_PAUSE;
        continue;
      }
      const why = response ? (await response.text().catch(() => response.statusText)).trim() : "the connection is lost";
      if (response?.status === UNKNOWN_PAGE) {
        this.restart();
        for (const command of this.waiting) command.number = ++this.number;
      } else if (response && !TEMPORARY.includes(response.status)) {
        this.waiting.shift();
        this.showMessage(`Not painted: ${why}`);
      } else {
        const count = this.waiting.length;
        this.showMessage(`${count} ${count === 1 ? "change waits" : "changes wait"} to be sent: ${why}`);
        await new Promise((resume) => setTimeout(resume, pause));
        pause = Math.min(2 * pause, MAX_PAUSE);
      }
    }
  }

  async post(body) {
    try {
      return await fetch("session", { method: "POST", body, headers: { "Content-Type": "application/octet-stream" } });
    } catch {
      return null;
    }
  }
}

// Compress a Blob as raw deflate.
export async function deflate(blob) {
  return new Uint8Array(await new Response(blob.stream().pipeThrough(new CompressionStream("deflate-raw"))).arrayBuffer());
}
