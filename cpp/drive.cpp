// Drives a point to a goal 4 m ahead, past a person, and prints what it is told: the smallest program there is.
//
//   g++ -std=c++17 -O3 -o drive cpp/drive.cpp && ./drive recipes/policies/navigation 0.2 0.5 0.3
#include <cstdio>
#include <cstdlib>

#include "torchrl_morl.hpp"

int main(int count, char** arguments) {
  if (count < 2) {
    std::fprintf(stderr, "usage: drive POLICY WEIGHT...   a weight for each objective, 1 together\n");
    return 2;
  }
  using namespace torchrl_morl;
  try {
    Policy policy(arguments[1]);
    Options options;
    // Your robot, for a policy that reads which one it drives: here a TurtleBot 2.
    if (policy.sensing.observe_robot) options.robot = {0.177, 0.5, pi};
    // The fields of your driver's LaserScan.
    Runner runner(std::move(policy), {-pi, pi / 180, 360, 0.12, 3.5}, options);
    std::vector<double> preference;
    for (int i = 2; i < count; ++i) {
      char* end = nullptr;
      preference.push_back(std::strtod(arguments[i], &end));
      if (end == arguments[i] || *end != '\0')
        throw std::invalid_argument("WEIGHT must be a number, got '" + std::string(arguments[i]) + "'");
    }
    Pose robot{0.0, 0.0, 0.0};
    const double goal_x = 4.0, goal_y = 0.0, human_x = 2.0, human_y = 0.5, human_radius = 0.3;
    const auto seen = [&robot](double x, double y) {
      const double ahead = x - robot.x, left = y - robot.y;
      return Polar{std::hypot(ahead, left), std::remainder(std::atan2(left, ahead) - robot.heading, 2 * pi)};
    };
    for (int step = 0; step < 300; ++step) {
      const double time = step * runner.policy.period;
      const Polar goal = seen(goal_x, goal_y), human = seen(human_x, human_y);
      std::vector<double> ranges;  // of your lidar: here a circle around the person, and nothing else
      for (std::size_t beam = 0; beam < runner.lidar.num_beams; ++beam) {
        const double angle =
            runner.lidar.first_angle + runner.lidar.increment * static_cast<double>(beam) - human.bearing;
        const double across = human.distance * std::sin(angle);
        const bool hit = std::cos(angle) > 0 && std::abs(across) < human_radius;
        ranges.push_back(hit ? human.distance * std::cos(angle) -
                                   std::sqrt(human_radius * human_radius - across * across)
                             : std::numeric_limits<double>::infinity());
      }
      const Command command = runner.step(&ranges, goal, human, preference, time, time, {}, robot);
      std::printf("%5.1f s  x %5.2f  y %5.2f  %.3f m/s  %6.3f rad/s  %s %s\n", time, robot.x, robot.y, command.speed,
                  command.turn_rate, command.reason.c_str(), command.detail.c_str());
      if (command.reason != "drive") return command.reason == "goal reached" ? 0 : 1;
      // Your base does this by itself.
      robot.heading += command.turn_rate * runner.policy.period;
      robot.x += command.speed * runner.policy.period * std::cos(robot.heading);
      robot.y += command.speed * runner.policy.period * std::sin(robot.heading);
    }
    return 1;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "drive: error: %s\n", error.what());
    return 2;
  }
}
