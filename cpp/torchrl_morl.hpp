// A policy of torchrl_morl on a robot, in C++17 and with the standard library alone.
//
//   torchrl_morl::Options options;
//   options.robot = {0.177, 0.5, 3.1416, 6.2832, 3.5, 0.0};  // radius, speeds, lidar: view, range, x
//   torchrl_morl::Runner runner(torchrl_morl::Policy("recipes/policies/navigation"),
//                               {-3.1416, 0.017453, 360, 0.12, 3.5}, options);
//   auto command = runner.step(&ranges, torchrl_morl::Polar{6.0, 0.3}, torchrl_morl::Polar{2.5, -0.4},
//                              {0.2, 0.5, 0.3}, stamp, now, {}, odometry);
//   // command.speed (m/s), command.turn_rate (rad/s), command.reason
//
// It reads the folder of a policy as it is: nothing has to be exported. What it computes and what it refuses are
// those of torchrl_morl.deploy.PolicyRunner. It is no safety function: a bumper or a safety lidar stays necessary.
//
// The frame of the robot: origin at the rotation centre, x ahead, y to the left, angles counter-clockwise. Metres,
// radians, seconds. One object is for one thread.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "torchrl_morl_files.hpp"
#include "torchrl_morl_sensing.hpp"

namespace torchrl_morl {

// A trained policy. Throws std::runtime_error, in one line, for files that are not what they should be.
class Policy {
 public:
  explicit Policy(const std::string& folder) {
    const std::string config_file = folder + "/policy.json", weights_file = folder + "/policy.safetensors";
    const files::Json config = files::Json::parse(files::read_file(config_file, 16u << 20), config_file);
    if (config.integer("format") != 2)
      throw files::broken(config_file, "has format " + std::to_string(config.integer("format")) +
                                           ", this reads 2: save the policy again");
    if (config.null("sensing")) throw files::broken(config_file, "does not tell what the policy senses");
    read_contract(config);
    const std::string bytes = files::read_file(weights_file, 1u << 30);
    if (files::sha256(bytes) != config.text("checksum"))
      throw files::broken(weights_file, "is not the file that policy.json was written with: copy the folder again");
    read_layers(config.object("network"), files::safetensors(bytes, weights_file), weights_file);
  }

  Sensing sensing;
  std::pair<double, double> speed, turn_rate;  // limits, m/s and rad/s
  double period = 0;                           // s
  std::string robot;
  std::vector<std::string> preference_names;  // order of a preference

  // Speed (m/s) and turn rate (rad/s). Throws std::invalid_argument for an input that is not finite, negative,
  // missing or off the simplex. which: robot it drives, motion: how it moves, for policies that read it.
  std::array<double, 2> act(const std::vector<double>& preference, const std::vector<double>& lidar, Polar goal,
                            std::optional<Polar> human = {}, std::optional<Velocity> human_velocity = {},
                            std::optional<Robot> which = {}, std::optional<Motion> motion = {}) const {
    sensing.check(which);
    if (which) which->check();
    if (lidar.size() != sensing.num_sectors)
      throw std::invalid_argument("lidar must have " + std::to_string(sensing.num_sectors) + " entries, got " +
                                  std::to_string(lidar.size()));
    std::vector<float> features;
    const float shortest = static_cast<float>(1e-3 / sensing.max_range);
    for (std::size_t sector = 0; sector < lidar.size(); ++sector) {
      float range = std::min(length("lidar", lidar[sector]), static_cast<float>(sensing.max_range));
      if (which) range = from_hull(range, sector, *which);
      features.push_back(std::log(std::max(range / static_cast<float>(sensing.max_range), shortest)) / 3.0f);
    }
    add_polar(features, "goal", goal, sensing.goal_range.second, sensing.goal_scale);
    const Polar nobody{sensing.nobody.first, sensing.nobody.second}, seen = human.value_or(nobody);
    if (sensing.observe_human) add_polar(features, "human", seen, sensing.human_range.second, sensing.human_scale);
    if (sensing.observe_human_velocity) {
      if (human && !human_velocity)
        throw std::invalid_argument(
            "this policy reads the human's velocity: give it, ahead and to the left in m/s, or odometry to "
            "Runner::step");
      const Velocity moving = human_velocity.value_or(Velocity{0.0, 0.0});
      const float unit = which ? static_cast<float>(which->top_speed) : 1.0f;
      features.push_back(finite("human_velocity", moving.ahead) / unit);
      features.push_back(finite("human_velocity", moving.left) / unit);
    }
    if (sensing.observe_nobody) {
      // Distances beyond those of the training read as the furthest of them, that of nobody as well.
      const auto read = [this](Polar at) {
        const double near = std::min(at.distance, sensing.human_range.second);
        return std::make_pair(static_cast<float>(near), static_cast<float>(at.bearing));
      };
      features.push_back(read(seen) == read(nobody) ? 1.0f : 0.0f);
    }
    if (which) add_robot(features, *which);
    if (sensing.observe_motion) {
      if (!motion)
        throw std::invalid_argument(
            "this policy reads how the robot moves: give motion, measured speed and turn rate and the last four "
            "commands, or odometry to Runner::step");
      for (std::size_t i = 0; i < motion->size(); ++i) {
        const double unit = !which ? 1.0 : i % 2 == 0 ? which->top_speed : which->top_turn_rate;
        features.push_back(finite("motion", (*motion)[i]) / static_cast<float>(unit));
      }
    }
    add_preference(features, preference);
    const std::vector<float> action = run(std::move(features));
    std::array<double, 2> command{};
    const auto limits = limits_of(which);
    for (std::size_t i = 0; i < 2; ++i) {
      const float low = static_cast<float>(limits[i].first), high = static_cast<float>(limits[i].second);
      command[i] = static_cast<double>((high + low) / 2 + (high - low) / 2 * std::tanh(action[i]));
      if (!std::isfinite(command[i])) throw std::invalid_argument("the policy's command is not finite");
    }
    return command;
  }

  // Lowest and highest speed (m/s) and turn rate (rad/s): those of the robot where the policy reads which it is.
  std::array<std::pair<double, double>, 2> limits_of(const std::optional<Robot>& which) const {
    if (!which) return {speed, turn_rate};
    return {std::pair{0.0, which->top_speed}, std::pair{-which->top_turn_rate, which->top_turn_rate}};
  }

 private:
  struct Layer {
    std::size_t inputs, outputs;
    std::vector<float> weights, bias;  // weights [inputs, outputs]
  };

  static float finite(const char* name, double value) {
    const float found = static_cast<float>(value);
    if (!std::isfinite(found)) throw std::invalid_argument(std::string(name) + " must be finite, got " + shown(value));
    return found;
  }
  static float length(const char* name, double value) {
    const float found = finite(name, value);
    if (found < 0)
      throw std::invalid_argument(std::string(name) + " has the length " + shown(value) +
                                  " m: it must not be negative");
    return found;
  }
  static void add_polar(std::vector<float>& features, const char* name, Polar at, double furthest, double scale) {
    const float distance = std::min(length(name, at.distance), static_cast<float>(furthest));
    const float bearing = finite(name, at.bearing);
    features.insert(features.end(), {distance / static_cast<float>(scale), std::sin(bearing), std::cos(bearing)});
  }
  // The free distance along the middle of a sector.
  float from_hull(float range, std::size_t sector, const Robot& which) const {
    const float width = static_cast<float>(2 * pi / static_cast<double>(sensing.num_sectors));
    const float angle = (static_cast<float>(sector) + 0.5f) * width;
    const float ahead = static_cast<float>(which.ahead) + range * std::cos(angle), left = range * std::sin(angle);
    return std::max(std::sqrt(ahead * ahead + left * left) - static_cast<float>(which.radius), 1e-3f);
  }
  void add_robot(std::vector<float>& features, Robot which) const {
    // What becomes 1: see torchrl_morl.transforms.robot. A lidar that sees further reads as one that sees as far.
    constexpr std::array<double, 6> scales{0.25, 1.0, pi, 2 * pi, 10.0, 0.25};
    which.range = std::min(which.range, sensing.max_range);
    const std::array<double, 6> numbers = which.numbers();
    for (std::size_t i = 0; i < scales.size(); ++i)
      features.push_back(finite("robot", numbers[i]) / static_cast<float>(scales[i]));
  }
  void add_preference(std::vector<float>& features, const std::vector<double>& preference) const {
    if (preference.size() != preference_names.size())
      throw std::invalid_argument("preference must have " + std::to_string(preference_names.size()) + " entries, got " +
                                  std::to_string(preference.size()));
    float total = 0.0f;
    for (std::size_t i = 0; i < preference.size(); ++i) {
      const float weight = static_cast<float>(preference[i]);
      if (!(weight >= 0) || !std::isfinite(weight))
        throw std::invalid_argument("preference of '" + preference_names[i] + "' must be finite and >= 0, got " +
                                    shown(preference[i]));
      total += weight;
      features.push_back(weight);
    }
    if (!(std::abs(total - 1.0f) <= 1e-4f))
      throw std::invalid_argument("preference sums to " + shown(total) + "; it must sum to 1 within 0.0001");
  }

  std::vector<float> run(std::vector<float> values) const {
    for (std::size_t index = 0; index < layers_.size(); ++index) {
      const Layer& layer = layers_[index];
      std::vector<float> next = layer.bias;
      for (std::size_t i = 0; i < layer.inputs; ++i) {  // a row at a time, which compilers vectorise
        const float value = values[i], *weights = &layer.weights[i * layer.outputs];
        for (std::size_t j = 0; j < layer.outputs; ++j) next[j] += value * weights[j];
      }
      if (index + 1 < layers_.size())
        for (float& value : next) value = activation_(value);
      values = std::move(next);
    }
    return values;
  }

  void read_contract(const files::Json& config) {
    const files::Json& entries = config.object("sensing");
    sensing.num_sectors = entries.integer("num_sectors");
    sensing.max_range = entries.number("max_range");
    sensing.goal_scale = entries.number("goal_scale");
    sensing.human_scale = entries.number("human_scale");
    sensing.unknown_range = entries.number("unknown_range");
    sensing.lidar_origin = entries.pair("lidar_origin");
    sensing.goal_range = entries.pair("goal_range");
    sensing.human_range = entries.pair("human_range");
    sensing.nobody = entries.pair("nobody");
    sensing.observe_human = entries.flag("observe_human");
    sensing.observe_human_velocity = entries.flag("observe_human_velocity");
    // Files from before there were these lack them.
    sensing.observe_nobody = entries.has("observe_nobody") && entries.flag("observe_nobody");
    sensing.observe_robot = entries.has("observe_robot") && entries.flag("observe_robot");
    sensing.observe_motion = entries.has("observe_motion") && entries.flag("observe_motion");
    if (!sensing.observe_human && (sensing.observe_human_velocity || sensing.observe_nobody))
      throw files::broken("sensing", std::string(sensing.observe_nobody ? "observe_nobody" : "observe_human_velocity") +
                                         " must be false where observe_human is");
    if (entries.integer("history") != 1)
      throw files::broken("sensing", "history must be 1: this version has no memory");
    speed = config.object("limits").pair("speed");
    turn_rate = config.object("limits").pair("turn_rate");
    period = config.number("period");
    robot = config.text("robot");
    for (double positive :
         {sensing.max_range, sensing.goal_scale, sensing.human_scale, sensing.unknown_range, sensing.goal_range.second,
          sensing.human_range.second, sensing.nobody.first, period, static_cast<double>(sensing.num_sectors)})
      if (!(positive > 0))
        throw files::broken("policy.json", "num_sectors, ranges, scales, nobody and period must be positive");
    if (!(speed.first < speed.second && turn_rate.first < turn_rate.second))
      throw files::broken("policy.json", "limits must be in ascending order");
    for (const std::string& name : config.texts("objectives"))
      if (!config.object("static").has(name)) preference_names.push_back(name);
  }

  void read_layers(const files::Json& network, const std::map<std::string, files::Tensor>& tensors,
                   const std::string& where) {
    activation_ = activation(network.text("activation"), where);
    std::vector<double> sizes = network.numbers("num_cells");
    for (double size : sizes)
      if (!(size >= 1 && size <= 16777216.0)) throw files::broken(where, "num_cells must be between 1 and 16777216");
    std::size_t inputs = sensing.observation_size() + preference_names.size();
    sizes.push_back(2);
    for (std::size_t index = 0; index < sizes.size(); ++index) {
      const std::string name = "module.0.module." + std::to_string(2 * index);
      const auto weight = tensors.find(name + ".weight"), bias = tensors.find(name + ".bias");
      const std::size_t outputs = static_cast<std::size_t>(sizes[index]);
      if (weight == tensors.end() || bias == tensors.end()) throw files::broken(where, "lacks the tensors of " + name);
      if (weight->second.shape != std::vector<std::size_t>{outputs, inputs} ||
          bias->second.shape != std::vector<std::size_t>{outputs})
        throw files::broken(where, name + " does not fit policy.json");
      Layer layer{inputs, outputs, std::vector<float>(inputs * outputs), bias->second.values};
      for (std::size_t j = 0; j < outputs; ++j)
        for (std::size_t i = 0; i < inputs; ++i) layer.weights[i * outputs + j] = weight->second.values[j * inputs + i];
      layers_.push_back(std::move(layer));
      inputs = outputs;
    }
  }

  // With the defaults of PyTorch.
  static std::function<float(float)> activation(const std::string& name, const std::string& where) {
    if (name == "ReLU") return [](float x) { return std::max(x, 0.0f); };
    if (name == "Tanh") return [](float x) { return std::tanh(x); };
    if (name == "ELU") return [](float x) { return x > 0 ? x : std::expm1(x); };
    if (name == "GELU") return [](float x) { return 0.5f * x * (1 + std::erf(x * 0.70710678f)); };
    if (name == "LeakyReLU") return [](float x) { return x > 0 ? x : 0.01f * x; };
    if (name == "SELU") return [](float x) { return 1.05070099f * (x > 0 ? x : 1.67326324f * std::expm1(x)); };
    if (name == "SiLU") return [](float x) { return x / (1 + std::exp(-x)); };
    if (name == "Sigmoid") return [](float x) { return 1 / (1 + std::exp(-x)); };
    if (name == "Softplus") return [](float x) { return x > 20 ? x : std::log1p(std::exp(x)); };
    throw files::broken(where, "has the activation " + name + ", which this does not know");
  }

  std::vector<Layer> layers_;
  std::function<float(float)> activation_;
};

}  // namespace torchrl_morl

#include "torchrl_morl_runner.hpp"
