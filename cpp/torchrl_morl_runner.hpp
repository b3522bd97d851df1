// Drives a robot with a policy, and stops it: included by torchrl_morl.hpp, which says how it is used.
#pragma once

#include "torchrl_morl.hpp"

namespace torchrl_morl {

// What the base is told. A base that has got no other command by valid_until must stop on its own: nothing here runs
// if the process hangs.
struct Command {
  double speed, turn_rate;     // m/s, rad/s
  std::string reason, detail;  // "drive", or why the robot stops; the same for a person to read
  double valid_until;          // s, on the clock of time
};

// Left out: those of the training.
struct Options {
  std::optional<double> goal_radius;    // m
  std::optional<double> timeout;        // s, after which an input is too old
  std::optional<double> max_speed;      // m/s; lowered together with the turn rate: the same arc, more slowly
  std::optional<double> max_turn_rate;  // rad/s
  std::optional<Robot> robot;           // which one it is, for policies that read it and for no other
};

// One step() a control period. It stops, with speed and turn rate 0, for these reasons: "goal reached", "clock",
// "stale", "no scan", "no goal", "refused".
class Runner {
 public:
  Runner(Policy with, Lidar from, Options options = {})
      : policy(std::move(with)), lidar(from), robot(options.robot), origin_(policy.sensing.lidar_origin) {
    lidar.check();
    const Sensing& sensing = policy.sensing;
    if (std::abs(lidar.increment) > 2 * pi / static_cast<double>(sensing.num_sectors) * (1 + sector_edge))
      throw std::invalid_argument("lidar: too few beams: the policy needs at least " +
                                  std::to_string(sensing.num_sectors) + " a revolution");
    sensing.check(robot);
    if (robot) robot = robot->with(lidar);
    if (robot) origin_ = {robot->ahead, 0.0};  // of such a policy, ranges are those of the lidar where it is
    const auto limits = policy.limits_of(robot);
    const auto fastest = [](std::pair<double, double> limit) {
      return std::max(std::abs(limit.first), std::abs(limit.second));
    };
    goal_radius = positive("goal_radius", options.goal_radius.value_or(sensing.goal_range.first));
    timeout = positive("timeout", options.timeout.value_or(policy.period));
    fastest_ = {fastest(limits[0]), fastest(limits[1])};
    max_speed = positive("max_speed", options.max_speed.value_or(fastest(limits[0])));
    max_turn_rate = positive("max_turn_rate", options.max_turn_rate.value_or(fastest(limits[1])));
  }

  Policy policy;
  Lidar lidar;
  std::optional<Robot> robot;
  double goal_radius, timeout, max_speed, max_turn_rate;

  // Command for the next control period; it throws for nothing that it is given.
  //
  // ranges: of the scan, or nullptr. human: the nearest person, or nothing for nobody. preference: in the order of
  // policy.preference_names. stamp: when the oldest input was measured; time: now, on the same clock. For policies that
  // read the human's velocity give human_velocity, or odometry: where the robot is in any fixed frame. Those that read
  // how the robot moves need it: that is what changed since the last step, and what was commanded then.
  Command step(const std::vector<double>* ranges, std::optional<Polar> goal, std::optional<Polar> human,
               const std::vector<double>& preference, double stamp, double time,
               std::optional<Velocity> human_velocity = {}, std::optional<Pose> odometry = {}) {
    const std::optional<double> last = time_;
    if (std::isfinite(time)) time_ = time;
    if (!std::isfinite(time) || !std::isfinite(stamp)) return stop("clock", "time and stamp must be finite numbers");
    if (last && time <= *last)
      return stop("clock", "time is " + shown(time) + " s, at the last step it was " + shown(*last) + " s");
    const double age = time - stamp;
    if (age < -timeout) return stop("clock", "stamp is " + shown(-age) + " s later than time: two clocks");
    if (age > timeout + 1e-9)
      return stop("stale", "the inputs are " + shown(age) + " s old, at most " + shown(timeout) + " s are allowed");
    if (ranges == nullptr) return stop("no scan", "there is none");
    if (!goal) return stop("no goal", "there is none");
    std::array<double, 2> command{};
    bool seen = false;
    try {
      const Sensing& sensing = policy.sensing;
      std::vector<double> sectors =
          lidar.sectors(*ranges, sensing.num_sectors, sensing.max_range, origin_.first, origin_.second);
      for (double& range : sectors) {
        seen = seen || !std::isnan(range);
        if (std::isnan(range)) range = sensing.unknown_range;
      }
      if (human) check(*human);
      const bool tracked = human && !human_velocity && odometry;
      if (sensing.observe_motion || tracked) moved(odometry, stamp);
      if (tracked) human_velocity = velocity_of(*human, *odometry, stamp);
      std::optional<Motion> motion;
      if (sensing.observe_motion) motion = motion_now();
      command = policy.act(preference, sectors, *goal, human, human ? human_velocity : std::nullopt, robot, motion);
    } catch (const std::exception& error) {
      return stop("refused", error.what());
    }
    if (!seen) return stop("no scan", "the scan has no valid beam");
    if (goal->distance <= goal_radius) return stop("goal reached", "the goal is " + shown(goal->distance) + " m away");
    const double share = std::min(
        {1.0, max_speed / std::max(std::abs(command[0]), 1e-9), max_turn_rate / std::max(std::abs(command[1]), 1e-9)});
    return told({command[0] * share, command[1] * share, "drive", "", time + timeout});
  }

 private:
  struct Seen {
    double stamp, x, y;
  };
  struct Stood {
    double stamp;
    Pose at;
  };

  static double positive(const char* name, double value) {
    if (!(std::isfinite(value) && value > 0))
      throw std::invalid_argument(std::string(name) + " must be finite and positive, got " + shown(value));
    return value;
  }
  static void check(Polar human) {
    if (!std::isfinite(human.distance) || !std::isfinite(human.bearing) || human.distance < 0)
      throw std::invalid_argument("human must be finite, with a distance of at least 0");
    if (human.distance == 0) throw std::invalid_argument("the human is at 0 m: for nobody pass no human");
  }

  // Of the human since the last step, along the axes of the robot; 0 at first sight, which a human is at again who was
  // gone for a second or moves faster than 3 m/s.
  Velocity velocity_of(Polar human, Pose robot, double stamp) {
    const Seen now{stamp, robot.x + human.distance * std::cos(robot.heading + human.bearing),
                   robot.y + human.distance * std::sin(robot.heading + human.bearing)};
    const double since = human_ ? stamp - human_->stamp : std::numeric_limits<double>::infinity();
    if (since > 0) {
      Velocity moved{0.0, 0.0};
      if (since <= 5 * policy.period) moved = {(now.x - human_->x) / since, (now.y - human_->y) / since};
      velocity_ = std::hypot(moved.ahead, moved.left) <= 3.0 ? moved : Velocity{0.0, 0.0};
      human_ = now;
    }
    const double cos = std::cos(robot.heading), sin = std::sin(robot.heading);
    return {cos * velocity_.ahead + sin * velocity_.left, cos * velocity_.left - sin * velocity_.ahead};
  }

  // Measures speed and turn rate since the last step. After as many periods without one as there are commands it
  // stood. What is further than it can have moved is odometry that jumped: first sight of everything.
  void moved(const std::optional<Pose>& odometry, double stamp) {
    if (!odometry) throw std::invalid_argument("this policy reads how the robot moves: give odometry");
    const Pose at = *odometry;
    if (!std::isfinite(at.x) || !std::isfinite(at.y) || !std::isfinite(at.heading))
      throw std::invalid_argument("odometry must be finite");
    const double since = stood_ ? stamp - stood_->stamp : std::numeric_limits<double>::infinity();
    if (since > static_cast<double>(told_.size()) * policy.period) {
      measured_ = {0.0, 0.0};
      told_ = {};
    } else if (since > 0) {
      const double x = at.x - stood_->at.x, y = at.y - stood_->at.y;
      const double turned = std::remainder(at.heading - stood_->at.heading, 2 * pi);
      if (std::hypot(x, y) <= 2 * fastest_[0] * since + 0.1 && std::abs(turned) <= 2 * fastest_[1] * since + 0.2) {
        measured_ = {(std::cos(at.heading) * x + std::sin(at.heading) * y) / since, turned / since};
      } else {
        measured_ = {0.0, 0.0};
        human_.reset();
      }
    }
    if (since > 0) stood_ = Stood{stamp, at};
  }

  Motion motion_now() const {
    Motion motion{measured_[0], measured_[1]};
    for (std::size_t i = 0; i < told_.size(); ++i) {
      motion[2 + 2 * i] = told_[i][0];
      motion[3 + 2 * i] = told_[i][1];
    }
    return motion;
  }

  Command stop(const char* reason, const std::string& detail) {
    return told({0.0, 0.0, reason, detail, time_ ? *time_ + timeout : std::numeric_limits<double>::infinity()});
  }
  Command told(Command command) {
    for (std::size_t i = told_.size() - 1; i > 0; --i) told_[i] = told_[i - 1];
    told_[0] = {command.speed, command.turn_rate};
    return command;
  }

  std::pair<double, double> origin_;  // of ranges, x and y
  std::optional<double> time_;
  std::optional<Seen> human_;
  Velocity velocity_{0.0, 0.0};  // along the axes of the fixed frame: east and north
  std::optional<Stood> stood_;
  std::array<double, 2> measured_{};             // speed and turn rate
  std::array<double, 2> fastest_{};              // of the robot, whatever its commands are lowered to
  std::array<std::array<double, 2>, 4> told_{};  // the last commands
};

}  // namespace torchrl_morl
