// What a policy senses, and where a lidar's beams point: included by torchrl_morl.hpp, which says how it is used.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <locale>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#ifdef __FAST_MATH__
#error "-ffast-math takes NaN for a number: invalid beams and broken inputs would not be seen"
#endif

namespace torchrl_morl {

constexpr double pi = 3.14159265358979323846;
// Share of a sector within which a beam before its start belongs to it: angles are rounded.
constexpr double sector_edge = 1e-4;

// m and rad, from the rotation centre.
struct Polar {
  double distance, bearing;
};

// m/s, over the ground, along the axes of the robot.
struct Velocity {
  double ahead, left;
};

// In any fixed frame, m and rad.
struct Pose {
  double x, y, heading;
};

inline std::string shown(double value) {
  std::ostringstream out;
  out.imbue(std::locale::classic());
  out << value;
  return out.str();
}

// Where the beams of a planar lidar point: the fields of sensor_msgs/LaserScan, and where it is mounted.
//
// range_min to range_max: an obstacle. Infinite, range_max and above: free. -inf: an obstacle at range_min. NaN, 0,
// negative, below range_min: as if the beam did not exist.
struct Lidar {
  double first_angle, increment;
  std::size_t num_beams;
  double range_min, range_max;
  Pose mount{0.0, 0.0, 0.0};

  void check() const {
    for (double value : {first_angle, increment, range_min, range_max, mount.x, mount.y, mount.heading})
      if (!std::isfinite(value)) throw std::invalid_argument("lidar: every field must be finite");
    if (num_beams < 1 || increment == 0.0)
      throw std::invalid_argument("lidar: it needs beams, and an increment that is not 0");
    if (std::abs(increment) * static_cast<double>(num_beams - 1) > 2 * pi + 1e-3)
      throw std::invalid_argument("lidar: more beams than a revolution has: is the increment in radians?");
    if (num_beams > 1000000) throw std::invalid_argument("lidar: num_beams must be at most 1000000");
    if (std::abs(first_angle) > 2 * pi + 1e-3 || std::abs(mount.heading) > 2 * pi + 1e-3)
      throw std::invalid_argument("lidar: first_angle and the mount's yaw must be within a revolution, in radians");
    if (std::hypot(mount.x, mount.y) > 10)
      throw std::invalid_argument("lidar: mount must be within 10 m of the rotation centre, in metres");
    if (!(0 <= range_min && range_min < range_max))
      throw std::invalid_argument("lidar: range_min must be between 0 and range_max, got " + shown(range_min));
  }

  // Shortest range in each sector around a point of the robot; NaN where no beam is valid.
  std::vector<double> sectors(const std::vector<double>& ranges, std::size_t num_sectors, double max_range,
                              double origin_x, double origin_y) const {
    if (ranges.size() != num_beams)
      throw std::invalid_argument("ranges must have " + std::to_string(num_beams) + " entries, one a beam, got " +
                                  std::to_string(ranges.size()));
    // Drivers report float32: their 0.12 is a little less than 0.12, and 0.12 all the same.
    const double near = std::min(range_min, static_cast<double>(static_cast<float>(range_min)));
    const double far = std::min(range_max, static_cast<double>(static_cast<float>(range_max)));
    const double ahead = mount.x - origin_x, left = mount.y - origin_y;
    const bool centred = std::hypot(ahead, left) < 1e-9;
    std::vector<double> out(num_sectors, std::numeric_limits<double>::quiet_NaN());
    for (std::size_t beam = 0; beam < num_beams; ++beam) {
      const double range = ranges[beam];
      const bool too_close = range == -std::numeric_limits<double>::infinity(), free = range >= far;
      if (!too_close && !(range >= near && range > 0)) continue;
      double length = too_close ? range_min : free ? max_range : range;
      double angle = mount.heading + first_angle + increment * static_cast<double>(beam);
      if (!centred) {
        const double x = ahead + length * std::cos(angle), y = left + length * std::sin(angle);
        angle = std::atan2(y, x);
        length = free ? max_range : std::hypot(x, y);
      }
      length = std::min(length, max_range);
      const double n = static_cast<double>(num_sectors);
      const double sector = std::floor(angle * (n / (2 * pi)) + sector_edge);
      double& shortest = out[static_cast<std::size_t>(sector - n * std::floor(sector / n)) % num_sectors];
      if (!(shortest <= length)) shortest = length;  // NaN as well
    }
    return out;
  }
};

// How the robot moves, for policies that read it: speed (m/s) and turn rate (rad/s), measured, then those of its last
// four commands, the latest first.
using Motion = std::array<double, 10>;

// Which robot it is, for policies that read it.
struct Robot {
  double radius;                    // m
  double top_speed, top_turn_rate;  // m/s, rad/s; commands are within them
  // Of the lidar: rad, m, and how far ahead of the rotation centre it is, m. Left out, NaN: what the runner's lidar has.
  double view = std::numeric_limits<double>::quiet_NaN(), range = view, ahead = view;

  // The same with this lidar; throws for a view, a range or a place that it does not have.
  Robot with(const Lidar& lidar) const {
    const double own_view = std::min(std::abs(lidar.increment) * static_cast<double>(lidar.num_beams), 2 * pi);
    const double own_range = std::min(lidar.range_max, 100.0);
    const auto or_own = [](double given, double own) { return std::isnan(given) ? own : given; };
    const Robot whole{radius,
                      top_speed,
                      top_turn_rate,
                      or_own(view, own_view),
                      or_own(range, own_range),
                      or_own(ahead, lidar.mount.x)};
    const auto refuse = [](const char* name, double value, const char* theirs, double own) {
      throw std::invalid_argument("robot: the " + std::string(name) + " of the lidar is " + shown(value) + ", but " +
                                  theirs + " " + shown(own) + ": leave the lidar's three numbers out");
    };
    whole.check();
    // Numbers are rounded, a range is reported in float32.
    if (whole.view > own_view * 1.01 + 0.01) refuse("view", whole.view, "its beams cover", own_view);
    if (whole.range > own_range * 1.001) refuse("range", whole.range, "its range_max is", own_range);
    if (std::abs(whole.ahead - lidar.mount.x) > 0.01) refuse("place ahead", whole.ahead, "its mount is at", lidar.mount.x);
    return whole;
  }

  std::array<double, 6> numbers() const { return {radius, top_speed, top_turn_rate, view, range, ahead}; }

  void check() const {
    const std::array<double, 6> found = numbers();
    std::string text;
    for (double value : found) text += (text.empty() ? "" : ", ") + shown(value);
    for (double value : found)
      if (!std::isfinite(value)) throw std::invalid_argument("robot must be finite, got " + text);
    if (*std::min_element(found.begin(), found.end() - 1) < 1e-3)
      throw std::invalid_argument("robot must have a radius, limits, view and range above 0, got " + text);
    // As in Python: angles beyond are degrees by mistake, lengths millimetres.
    const char* names[] = {"radius", "top speed", "top turn rate", "view of the lidar", "range of the lidar"};
    const char* units[] = {"m", "m/s", "rad/s", "rad", "m"};
    const double most[] = {2.0, 10.0, 12.6, 6.3, 100.0};
    for (std::size_t i = 0; i < 5; ++i)
      if (found[i] > most[i])
        throw std::invalid_argument("robot: the " + std::string(names[i]) + " must be at most " + shown(most[i]) + " " +
                                    units[i] + ", got " + shown(found[i]));
    if (std::abs(ahead) > radius)
      throw std::invalid_argument("robot: the lidar must be within the radius of " + shown(radius) + " m, got " +
                                  shown(ahead) + " m ahead");
  }
};

// What a policy was trained to sense: see torchrl_morl.deploy.Sensing.
struct Sensing {
  std::size_t num_sectors = 0;
  double max_range = 0, goal_scale = 0, human_scale = 0, unknown_range = 0;
  std::pair<double, double> lidar_origin, goal_range, human_range, nobody;
  bool observe_human = false, observe_human_velocity = false, observe_nobody = false, observe_robot = false;
  bool observe_motion = false;

  std::size_t observation_size() const {
    return num_sectors + 3 + 3 * observe_human + 2 * observe_human_velocity + observe_nobody + 6 * observe_robot +
           10 * observe_motion;
  }

  // Throws std::invalid_argument for a robot that the policy does not read, or none where it does.
  void check(const std::optional<Robot>& robot) const {
    if (!observe_robot) {
      if (robot) throw std::invalid_argument("this policy does not read robot, sensing.observe_robot is false");
      return;
    }
    if (!robot)
      throw std::invalid_argument(
          "this policy reads which robot it drives (sensing.observe_robot): give robot, its radius (m), top speed "
          "(m/s) and top turn rate (rad/s)");
  }
};

}  // namespace torchrl_morl
