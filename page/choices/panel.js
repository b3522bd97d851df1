// "You choose": two drives side by side, which is better? After each answer what is found, and "Drive so".
import { CONTROL_PERIOD } from "../simulation/drive.js";
import { MARKS, css } from "../view/colors.js";
import { byId, wordsOf } from "../view/controls.js";
import { alternative } from "./alternative.js";
import { Dialogue, KEYS } from "./dialogue.js";
import { drawMap } from "./map.js";
import { Picture } from "./picture.js";

const PACE = 3; // simulated seconds in one
const PAUSE = 1.5; // seconds at the end, before both start again
const ENOUGH = 5; // answers
const BUTTONS = { first: "1", second: "2", same: "=", neither: "n", undo: "u", skip: "s" };
const CODES = { ArrowLeft: "1", ArrowRight: "2", Backspace: "u" };
const SAID = { 1: "the first one", 2: "the second one", "=": "the same", n: "neither", s: "something else" };

// A line does not break before the sign.
const percent = (value) => `${Math.round(100 * value)}\u00a0%`;

export class Chooser {
  /** `onDrive` is given the preference to drive with; `onChange` is told that the answers have changed. */
  constructor(session, { announce, onDrive, onChange }) {
    this.session = session;
    this.announce = announce;
    this.onChange = onChange;
    this.active = false;
    this.playing = !window.matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.elapsed = 0;
    const told = session.contents.choices;
    byId("choose").hidden = !told;
    if (!told) return;
    this.policy = session.policies[told.policy];
    this.entry = session.contents.policies[told.policy];
    this.pictures = ["first", "second"].map(
      (id, side) => new Picture(byId(id).querySelector("canvas"), side, session.contents.robot),
    );
    for (const [id, key] of Object.entries(BUTTONS)) byId(id).addEventListener("click", () => this.type(key));
    byId("over").addEventListener("click", () => {
      this.dialogue.restart();
      this.#follow("All answers are forgotten");
    });
    byId("choices-play").addEventListener("click", () => this.#play());
    byId("drive-so").addEventListener("click", () => onDrive(this.dialogue.best.preference, told.policy));
    new ResizeObserver(() => this.pictures.forEach((picture) => picture.fit())).observe(byId("pair"));
  }

  /** Made when it is first needed. */
  get dialogue() {
    this.made ??= new Dialogue(this.session.contents.choices);
    return this.made;
  }

  /** What was typed, for a link. */
  get log() {
    return this.made?.log ?? "";
  }

  /** Show or hide it. */
  show(active) {
    this.active = active && Boolean(this.session.contents.choices);
    document.body.classList.toggle("choosing", this.active);
    byId("choices").hidden = !this.active;
    byId("choices-card").hidden = !this.active;
    if (this.active) this.#follow();
  }

  /** Take answers of a link. */
  restore(log) {
    if (!this.session.contents.choices || (!log && !this.made)) return;
    this.dialogue.replay(log);
    if (this.active) this.#follow();
  }

  /** A key of the keyboard; true if it is one of these. */
  key({ key, code, repeat }) {
    const typed = CODES[code] ?? (key.length === 1 ? key.toLowerCase() : "");
    if (code === "Space") this.#play();
    else if (!(typed in KEYS || typed === "u" || typed === "s")) return false;
    // A key that is held down is one answer.
    else if (!repeat) this.type(typed);
    return true;
  }

  /** An answer, "u" or "s". */
  type(key) {
    if (!this.dialogue.take(key)) return;
    this.#follow(key === "u" ? "Taken back" : `You said: ${SAID[key]}`);
  }

  /** Draw both, `seconds` after the last time. */
  draw(theme, seconds) {
    if (this.theme !== theme) {
      this.theme = theme;
      this.#map();
    }
    const longest = Math.max(...this.drives.map(({ poses }) => poses.length - 1)) * CONTROL_PERIOD;
    if (this.playing) this.elapsed += seconds * PACE;
    if (this.elapsed > longest + PAUSE * PACE) this.elapsed = 0;
    // What stands still shows where it ends.
    for (const picture of this.pictures) picture.draw(theme, this.playing ? this.elapsed : longest);
  }

  #play() {
    this.playing = !this.playing;
    this.elapsed = 0;
    this.#showPlay();
  }

  #showPlay() {
    byId("choices-play").textContent = this.playing ? "Stand still" : "Play";
  }

  /** Everything shows the present question and what is known. */
  #follow(said) {
    const { dialogue, session } = this;
    const { scene: index, first, second } = dialogue.question;
    const scene = session.contents.choices.scenes[index];
    const { policy, entry } = this;
    const about = { robot: session.contents.robot, policy, entry };
    this.drives = [first, second].map((row) => alternative(scene, dialogue.preferences[row], about));
    const points = this.drives.flatMap(({ poses, demonstration }) => [...poses, ...(demonstration ?? [])]);
    this.elapsed = 0;
    ["first", "second"].forEach((id, side) => {
      this.pictures[side].take(scene, this.drives[side], points, entry.goal_radius);
      const facts = factsOf(this.drives[side]);
      byId(id).querySelector(".facts").textContent = facts.join(" · ");
      byId(id).setAttribute("aria-label", `Drive ${side + 1} is better: ${facts.join(", ")}`);
    });
    byId("question").textContent = `Question ${dialogue.count + 1}: which do you like better?`;
    byId("undo").disabled = byId("over").disabled = byId("drive-so").disabled = !dialogue.count;
    this.#showPlay();
    this.#found();
    this.onChange();
    if (said) this.announce(`${said}. ${byId("sure").textContent} ${byId("question").textContent}`);
  }

  #found() {
    const { dialogue, session } = this;
    const { count } = dialogue;
    const { preference, regret, regretHigh } = dialogue.best;
    const words = wordsOf({ policy: this.policy, contents: session.contents });
    const answers = count === 1 ? "1 answer" : `${count} answers`;
    byId("found").textContent = count ? `After ${answers}` : "What matters to you?";
    byId("sure").textContent = count
      ? `This should reach ${percent(1 - regret)} of what you could like, and with a probability of ${percent(0.9)} at least ${percent(1 - regretHigh)}.`
      : `Nobody knows yet. Say which of two drives you like better, five to ten times.`;
    byId("sureness").hidden = byId("found-weights").hidden = !count;
    byId("sureness").style.setProperty("--share", `${100 * (1 - regret)}%`);
    byId("sureness").style.setProperty("--low", `${100 * (1 - regretHigh)}%`);
    const { chance } = dialogue.posterior;
    const random = count >= ENOUGH && chance > 0.5;
    byId("random").hidden = !random;
    byId("random").textContent = `With a probability of ${percent(chance)} these answers follow nothing that the robot knows. Undo takes the last one back.`;
    byId("found-weights").replaceChildren(
      ...words.map((word, entry) => {
        const row = document.createElement("li");
        const mark = document.createElement("span");
        mark.className = `mark ${MARKS[entry % MARKS.length]}-mark`;
        const name = document.createElement("span");
        name.textContent = word;
        const value = document.createElement("b");
        value.textContent = percent(preference[entry]);
        row.append(mark, name, value);
        return row;
      }),
    );
    this.#map();
  }

  #map() {
    const { dialogue, theme } = this;
    const three = this.policy.tunable.length === 3;
    byId("map").hidden = !three;
    if (!theme) return;
    byId("found-weights")
      .querySelectorAll("li")
      .forEach((row, entry) => row.style.setProperty("--color", css(theme.corners[entry])));
    if (!three) return;
    const words = wordsOf({ policy: this.policy, contents: this.session.contents });
    byId("map")
      .querySelectorAll(".corner")
      .forEach((label, corner) => (label.textContent = words[corner]));
    drawMap(byId("map").querySelector("canvas"), dialogue.preferences, dialogue.count ? dialogue.best : null, theme);
  }
}

/** What a drive did, in words. */
function factsOf({ ending, seconds, nearest, style }) {
  if (ending !== "goal") return ["does not arrive"];
  const facts = [`${seconds.toFixed(0)} s`, `at least ${nearest.toFixed(1)} m from the person`];
  if (Number.isFinite(style)) facts.push(`${style.toFixed(1)} m off the demonstration`);
  return facts;
}
