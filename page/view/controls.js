// The panel beside the floor: what matters, where, what is shown.
import { MARKS, css } from "./colors.js";
import { Triangle, withWeight } from "./triangle.js";

/** How people call objectives; others have the label that they come with. */
const WORDS = {
  demo: "like the demonstration",
  distance: "far from the person",
  efficiency: "fast",
  clearance: "clear of boxes",
};

const SCENES = {
  showcase: "one fixed scene",
  static: "a person and boxes",
  moving_human: "a person comes along",
  corridor: "corridors that cross",
  empty: "a person alone",
};

const POLICIES = {
  navigation: "navigation, whatever people do",
  polished_seed0: "polished_seed0, for people who stand",
};

export const byId = (id) => document.getElementById(id);

export function wordsOf(session) {
  return session.policy.tunable.map(
    (name) => WORDS[name] ?? session.contents.objectives[name].label,
  );
}

/** The triangle, where there are three objectives, and a slider for each of any number. */
export class Weights {
  constructor(session, onChange) {
    this.session = session;
    this.onChange = onChange;
    this.triangle = new Triangle(byId("triangle"), {
      names: session.policy.tunable,
      onChange,
    });
  }

  /** Make the sliders anew, for the objectives of the present policy. */
  build(corners) {
    const words = wordsOf(this.session);
    const three = words.length === 3;
    byId("triangle").hidden = !three;
    if (three) {
      this.triangle.names = words;
      byId("triangle")
        .querySelectorAll(".corner")
        .forEach((label, corner) => (label.textContent = words[corner]));
      this.triangle.paint(corners);
    }
    const rows = words.map((word, entry) => {
      const row = document.createElement("label");
      row.className = "weight";
      row.style.setProperty("--color", css(corners[entry]));
      const mark = document.createElement("span");
      mark.className = `mark ${MARKS[entry % MARKS.length]}-mark`;
      const name = document.createElement("span");
      name.textContent = word;
      const output = document.createElement("output");
      const input = document.createElement("input");
      Object.assign(input, { type: "range", min: 0, max: 100, step: 1, name: word });
      input.setAttribute("aria-label", word);
      input.addEventListener("input", () => {
        this.onChange(withWeight(this.session.preference, entry, Number(input.value) / 100));
      });
      row.append(mark, name, output, input);
      return row;
    });
    byId("weights").replaceChildren(...rows);
    this.show();
  }

  show() {
    const { preference } = this.session;
    if (preference.length === 3) this.triangle.show(preference);
    byId("weights")
      .querySelectorAll(".weight")
      .forEach((row, entry) => {
        const percent = Math.round(100 * preference[entry]);
        row.querySelector("output").textContent = `${percent} %`;
        const input = row.querySelector("input");
        input.value = percent;
        input.style.setProperty("--share", `${percent}%`);
      });
  }
}

/** Fill the lists of scenes and policies. */
export function fillLists({ contents }) {
  const list = (names, words) =>
    names.map((name) => new Option(words[name] ? words[name] : name, name));
  byId("scene").replaceChildren(...list(Object.keys(contents.scenes), SCENES));
  byId("policy").replaceChildren(...list(Object.keys(contents.policies), POLICIES));
}

/** Make lists and boxes say what the session is set to. */
export function showSetting(session) {
  const [first, last] = session.seeds();
  byId("scene").value = session.sceneName;
  Object.assign(byId("seed"), { min: first, max: last, value: session.seed });
  byId("seed").disabled = first === last;
  byId("motion").value = session.motion;
  byId("policy").value = session.policyName;
  const shown = session.demonstration !== null;
  byId("show-demonstration").disabled = !shown;
  byId("style-number").hidden = !shown || session.driver !== null;
  byId("policy").parentElement.hidden = session.driver !== null;
  byId("show-previews").parentElement.hidden = session.driver !== null;
}

/** The numbers on the floor. */
export function showNumbers(session) {
  byId("time").textContent = `${session.seconds.toFixed(1)} s`;
  byId("distance").textContent = `${session.episode.humanDistance.toFixed(2)} m`;
  byId("nearest").textContent = `${session.nearest.toFixed(2)} m`;
  byId("style").textContent = `${session.styleDistance.toFixed(2)} m`;
}
