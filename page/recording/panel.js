// Recording of drives on the page: who drives, which were kept, and their files.
import { byId } from "../view/controls.js";
import { Drives } from "./drives.js";

export class Recorder {
  /** `announce` says what became of a drive. */
  constructor(session, hand, { announce }) {
    this.session = session;
    this.hand = hand;
    this.drives = new Drives();
    this.announce = announce;
    this.active = false;
    byId("download").addEventListener("click", () => save("drives.csv", this.drives.csv));
    byId("download-boxes").addEventListener("click", () => save("boxes.csv", this.drives.boxesCsv));
    window.addEventListener("beforeunload", (event) => {
      if (this.drives.kept.length && !this.saved) event.preventDefault();
    });
    byId("download").addEventListener("click", () => (this.saved = true));
    this.#list();
  }

  /** A new episode: what was driven of the last one and did not end is left out. */
  begin() {
    if (!this.active) return;
    this.hand.release();
    this.drives.begin();
  }

  /** A control step was made. */
  step() {
    if (!this.active) return;
    const { episode } = this.session;
    this.drives.add(episode);
    if (!episode.ending) return;
    const kept = this.drives.kept.length;
    this.announce(this.drives.finish(episode));
    this.saved &&= this.drives.kept.length === kept;
    this.#list();
  }

  /** Somebody takes over, or hands back. */
  show(active) {
    this.active = active;
    document.body.classList.toggle("driving", active);
    byId("record-card").hidden = !active;
    byId("preference-card").hidden = active;
    this.session.driver = active
      ? (episode) => {
          const command = this.hand.command(episode.body, this.session.contents.robot);
          // Where it all begins, before the first command moves anything.
          if (command && !this.drives.points.length) this.drives.add(episode);
          return command;
        }
      : null;
  }

  #list() {
    const { kept } = this.drives;
    byId("drives").replaceChildren(
      // The latest on top: the list may be longer than what is seen of it.
      ...[...kept].reverse().map(({ name, seconds, nearest, side }) => {
        const row = document.createElement("li");
        const text = `${name}: ${seconds.toFixed(0)} s, ${nearest.toFixed(1)} m on the ${side}`;
        const remove = document.createElement("button");
        Object.assign(remove, { type: "button", textContent: "remove" });
        remove.setAttribute("aria-label", `remove ${name}`);
        remove.addEventListener("click", () => {
          this.drives.remove(name);
          this.#list();
        });
        row.append(text, remove);
        return row;
      }),
    );
    const count = kept.length;
    byId("download").disabled = !count;
    const drives = count === 1 ? "1 drive" : `${count || "your"} drives`;
    byId("download").textContent = `Download ${drives}`;
    byId("download-boxes").hidden = this.drives.boxesCsv === null;
    const boxes = this.drives.boxesCsv === null ? "" : " --boxes boxes.csv";
    byId("teach").textContent = `python -m recipes.teach drives.csv${boxes}`;
  }
}

function save(name, text) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}
