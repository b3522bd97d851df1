// The runner for everything that calls C: ctypes, Rust, Go, MATLAB. Numbers in, numbers out, no exceptions.
//
//   g++ -std=c++17 -O3 -shared -fPIC -o libtorchrl_morl.so cpp/c_interface.cpp
//
// A null pointer is "not given": no scan, no goal, nobody.
#include <cstring>

#include "torchrl_morl.hpp"

namespace {

void copy(const std::string& text, char* out, std::size_t size) {
  if (out == nullptr || size == 0) return;
  const std::size_t length = std::min(text.size(), size - 1);
  std::memcpy(out, text.data(), length);
  out[length] = '\0';
}

}  // namespace

extern "C" {

// lidar: first_angle, increment, range_min, range_max, and x, y, yaw of the mount. options: goal_radius, timeout,
// max_speed, max_turn_rate, or null; NaN is the default. robot, for policies that read which one it is, and null for
// others: radius, top speed, top turn rate, and the lidar's view, range and distance ahead of the rotation centre,
// three NaN for those of the lidar above.
// Returns null, and says why in error, where it cannot be done.
void* torchrl_morl_open(const char* folder, const double* lidar, std::size_t num_beams, const double* options,
                        const double* robot, char* error, std::size_t error_size) {
  try {
    const auto option = [options](int index) {
      const bool given = options != nullptr && !std::isnan(options[index]);
      return given ? std::optional<double>(options[index]) : std::nullopt;
    };
    std::optional<torchrl_morl::Robot> which;
    if (robot) which = {robot[0], robot[1], robot[2], robot[3], robot[4], robot[5]};
    return new torchrl_morl::Runner(torchrl_morl::Policy(folder),
                                    {lidar[0], lidar[1], num_beams, lidar[2], lidar[3], {lidar[4], lidar[5], lidar[6]}},
                                    {option(0), option(1), option(2), option(3), which});
  } catch (const std::exception& problem) {
    copy(problem.what(), error, error_size);
    return nullptr;
  }
}

// goal, human: distance and bearing. human_velocity: ahead and left. odometry: x, y, heading. command: speed, turn
// rate and valid_until. reason: "drive", or why the robot stops; detail: the same for a person.
void torchrl_morl_step(void* runner, const double* ranges, std::size_t num_ranges, const double* goal,
                       const double* human, const double* human_velocity, const double* odometry,
                       const double* preference, std::size_t num_preference, double stamp, double time, double* command,
                       char* reason, std::size_t reason_size, char* detail, std::size_t detail_size) {
  using namespace torchrl_morl;
  const auto polar = [](const double* at) { return at ? std::optional<Polar>({at[0], at[1]}) : std::nullopt; };
  const std::vector<double> scan(ranges, ranges ? ranges + num_ranges : ranges);
  const Command found = static_cast<Runner*>(runner)->step(
      ranges ? &scan : nullptr, polar(goal), polar(human), std::vector<double>(preference, preference + num_preference),
      stamp, time, human_velocity ? std::optional<Velocity>({human_velocity[0], human_velocity[1]}) : std::nullopt,
      odometry ? std::optional<Pose>({odometry[0], odometry[1], odometry[2]}) : std::nullopt);
  command[0] = found.speed;
  command[1] = found.turn_rate;
  command[2] = found.valid_until;
  copy(found.reason, reason, reason_size);
  copy(found.detail, detail, detail_size);
}

void torchrl_morl_close(void* runner) { delete static_cast<torchrl_morl::Runner*>(runner); }

}  // extern "C"
