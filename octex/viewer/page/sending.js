// Sends what is painted, one command after the other, and again until the server has it. See session.py.

const FIRST_PAUSE = 300, MOST_PAUSE = 5000; // milliseconds until it is sent again
const COMMON = ["undo", "redo", "save", "layer"]; // commands that paint nothing
const AGAIN = [429, 503, 507]; // answers that a later one may differ from

export class Sending {
  // `tell` is called with what is wrong, or with nothing once that is over, `sent` after each command; `target` says
  // what commands paint.
  constructor(tell, target, sent) {
    Object.assign(this, { tell, target, sent });
    this.begin();
    this.waiting = [];
  }

  begin() {
    this.page = crypto.randomUUID();
    this.number = 0;
  }

  // Send a command and its bytes, or a promise of these; returns its number.
  send(command, content = new Uint8Array()) {
    const target = COMMON.includes(command.kind) ? {} : this.target();
    this.waiting.push({ ...target, ...command, number: ++this.number, content });
    this.running ||= this.run().finally(() => (this.running = null));
    this.sent();
    return this.number;
  }

  // Wait until all of it is sent.
  async all() {
    while (this.running) await this.running;
  }

  async run() {
    let pause = FIRST_PAUSE;
    while (this.waiting.length) {
      const { content, ...command } = this.waiting[0];
      const line = new TextEncoder().encode(`${JSON.stringify({ page: this.page, ...command })}\n`);
      const answer = await this.post(new Blob([line, await content]));
      if (answer?.ok) {
        this.waiting.shift();
        this.tell("");
        pause = FIRST_PAUSE;
      } else if (answer?.status === 409) {
        this.begin(); // the server knows nothing of this page
        for (const each of this.waiting) each.number = ++this.number;
      } else if (answer && !AGAIN.includes(answer.status)) {
        this.waiting.shift();
        this.tell(`Not painted: ${(await answer.text()).trim()}`);
      } else {
        const count = this.waiting.length, why = answer ? (await answer.text()).trim() : "the connection is lost";
        this.tell(`${count} ${count === 1 ? "change waits" : "changes wait"} to be sent: ${why}`);
        await new Promise((resume) => setTimeout(resume, pause));
        pause = Math.min(2 * pause, MOST_PAUSE);
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

// Bytes as raw deflate.
export async function deflated(bytes) {
  const packed = new Blob([bytes]).stream().pipeThrough(new CompressionStream("deflate-raw"));
  return new Uint8Array(await new Response(packed).arrayBuffer());
}
