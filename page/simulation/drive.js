// The planar drive of envs/mjcf.py: velocity servos along the robot's axes, integrated implicitly as MuJoCo does.
// Metres, radians, seconds, everywhere.

export const CONTROL_PERIOD = 0.2;
/** Time steps in a control step: contacts are looked for after each of them. */
export const SUBSTEPS = 4;
export const TIME_STEP = CONTROL_PERIOD / SUBSTEPS;

// Of the servo against slipping sideways, per kilogram.
const NO_SLIP_GAIN = 800;

/** A robot that stands at a pose [x, y, heading]. */
export function standing([x, y, heading]) {
  return { x, y, heading, vx: 0, vy: 0, turnRate: 0 };
}

/** One time step under a command [forward speed, turn rate], clipped to the robot's limits. Changes `body`. */
export function advance(body, command, robot) {
  const speed = Math.min(Math.max(command[0], 0), robot.max_speed);
  const turnRate = Math.min(Math.max(command[1], -robot.max_turn_rate), robot.max_turn_rate);
  const forwardGain = TIME_STEP / robot.linear_response;
  const turnGain = TIME_STEP / robot.angular_response;
  const cos = Math.cos(body.heading);
  const sin = Math.sin(body.heading);
  const ahead = (cos * body.vx + sin * body.vy + forwardGain * speed) / (1 + forwardGain);
  const left = (cos * body.vy - sin * body.vx) / (1 + TIME_STEP * NO_SLIP_GAIN);
  body.turnRate = (body.turnRate + turnGain * turnRate) / (1 + turnGain);
  body.vx = cos * ahead - sin * left;
  body.vy = sin * ahead + cos * left;
  body.x += TIME_STEP * body.vx;
  body.y += TIME_STEP * body.vy;
  body.heading += TIME_STEP * body.turnRate;
}
