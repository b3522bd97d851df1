// What torchrl_morl.hpp reads: JSON, SHA-256 and safetensors. C++17, standard library alone.
//
// A file is taken for hostile until it has been read: sizes are compared before anything is allocated, nesting
// is bounded, and whatever is wrong is a std::runtime_error with one line that names the file and the entry.
#pragma once

#include <cctype>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <locale>
#include <map>
#include <set>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "safetensors are little-endian, and this reads them as they are"
#endif

namespace torchrl_morl::files {

inline std::runtime_error broken(const std::string& where, const std::string& what) {
  return std::runtime_error(where + ": " + what);
}

inline std::string read_file(const std::string& path, std::size_t most) {
  std::ifstream file(path, std::ios::binary | std::ios::ate);
  const std::streamoff size = file ? static_cast<std::streamoff>(file.tellg()) : -1;
  if (size < 0 || size > INT64_MAX - 1)  // a folder opens, and has no size
    throw broken(path, "not found: a policy is a folder with policy.safetensors and policy.json");
  if (static_cast<std::uint64_t>(size) > most)
    throw broken(path, "is larger than " + std::to_string(most >> 20) + " MiB");
  std::string bytes(static_cast<std::size_t>(size), '\0');
  file.seekg(0);
  if (size > 0 && !file.read(&bytes[0], size)) throw broken(path, "cannot be read");
  return bytes;
}

// A JSON value. Entries of an object are asked for with the type that they must have.
class Json {
 public:
  enum class Kind { null, boolean, number, string, array, object };

  static Json parse(const std::string& text, const std::string& where);

  Kind kind() const { return kind_; }
  const std::vector<std::string>& keys() const { return keys_; }

  bool has(const std::string& name) const { return find(name) != nullptr; }
  bool null(const std::string& name) const { return at(name).kind_ == Kind::null; }
  const Json& object(const std::string& name) const { return of(name, Kind::object, "an object"); }
  bool flag(const std::string& name) const { return of(name, Kind::boolean, "true or false").truth_; }
  double number(const std::string& name) const { return of(name, Kind::number, "a finite number").number_; }
  const std::string& text(const std::string& name) const { return of(name, Kind::string, "a string").text_; }

  std::size_t integer(const std::string& name) const {
    const double found = number(name);
    if (!(found >= 0 && found <= 16777216.0 && found == std::floor(found)))
      throw broken(where_, name + " must be an integer between 0 and 16777216");
    return static_cast<std::size_t>(found);
  }

  std::vector<double> numbers(const std::string& name) const {
    std::vector<double> found;
    for (const Json& item : of(name, Kind::array, "a list").items_) {
      if (item.kind_ != Kind::number) throw broken(where_, name + " must be a list of finite numbers");
      found.push_back(item.number_);
    }
    return found;
  }

  std::pair<double, double> pair(const std::string& name) const {
    const std::vector<double> found = numbers(name);
    if (found.size() != 2) throw broken(where_, name + " must be 2 finite numbers");
    return {found[0], found[1]};
  }

  std::vector<std::string> texts(const std::string& name) const {
    std::vector<std::string> found;
    for (const Json& item : of(name, Kind::array, "a list").items_) {
      if (item.kind_ != Kind::string) throw broken(where_, name + " must be a list of strings");
      found.push_back(item.text_);
    }
    return found;
  }

 private:
  class Parser;

  const Json* find(const std::string& name) const {
    for (std::size_t i = 0; i < keys_.size(); ++i)
      if (keys_[i] == name) return &items_[i];
    return nullptr;
  }
  const Json& at(const std::string& name) const {
    const Json* found = find(name);
    if (found == nullptr) throw broken(where_, "lacks '" + name + "'");
    return *found;
  }
  const Json& of(const std::string& name, Kind wanted, const char* allowed) const {
    const Json& found = at(name);
    if (found.kind_ != wanted) throw broken(where_, name + " must be " + allowed);
    return found;
  }
  void call(const std::string& where) {
    where_ = where;
    for (std::size_t i = 0; i < keys_.size(); ++i) items_[i].call(where + ": " + keys_[i]);
  }

  Kind kind_ = Kind::null;
  bool truth_ = false;
  double number_ = 0.0;
  std::string text_, where_;
  std::vector<std::string> keys_;  // of an object, one for each item
  std::vector<Json> items_;
};

class Json::Parser {
 public:
  Parser(const std::string& text, const std::string& where) : text_(text), where_(where) {}

  Json document() {
    Json out = value(0);
    space();
    if (place_ != text_.size()) throw wrong();
    return out;
  }

 private:
  std::runtime_error wrong() const { return broken(where_, "is not valid JSON at byte " + std::to_string(place_)); }
  char peek() const { return place_ < text_.size() ? text_[place_] : '\0'; }
  bool digit() const { return peek() >= '0' && peek() <= '9'; }
  void space() {
    while (peek() == ' ' || peek() == '\t' || peek() == '\r' || peek() == '\n') ++place_;
  }
  bool take(char wanted) {
    space();
    if (peek() != wanted) return false;
    ++place_;
    return true;
  }
  void expect(char wanted) {
    if (!take(wanted)) throw wrong();
  }
  void word(const std::string& wanted) {
    if (text_.compare(place_, wanted.size(), wanted) != 0) throw wrong();
    place_ += wanted.size();
  }

  Json value(int depth) {
    if (depth > 64) throw broken(where_, "is not valid JSON: nested too deeply");
    space();
    Json out;
    const char first = peek();
    if (first == '{') {
      out.kind_ = Kind::object;
      ++place_;
      if (take('}')) return out;
      std::set<std::string> seen;
      do {
        space();
        out.keys_.push_back(string());
        // Of two, readers would take one or the other.
        if (!seen.insert(out.keys_.back()).second)
          throw broken(where_, "is not valid JSON: '" + out.keys_.back() + "' stands there twice");
        expect(':');
        out.items_.push_back(value(depth + 1));
      } while (take(','));
      expect('}');
    } else if (first == '[') {
      out.kind_ = Kind::array;
      ++place_;
      if (take(']')) return out;
      do {
        out.items_.push_back(value(depth + 1));
      } while (take(','));
      expect(']');
    } else if (first == '"') {
      out.kind_ = Kind::string;
      out.text_ = string();
    } else if (first == 't' || first == 'f') {
      out.kind_ = Kind::boolean;
      out.truth_ = first == 't';
      word(out.truth_ ? "true" : "false");
    } else if (first == 'n') {
      word("null");
    } else {
      out.kind_ = Kind::number;
      out.number_ = number();
    }
    return out;
  }

  double number() {
    const std::size_t start = place_;
    if (peek() == '-') ++place_;
    digits();
    if (peek() == '.') {
      ++place_;
      digits();
    }
    if (peek() == 'e' || peek() == 'E') {
      ++place_;
      if (peek() == '+' || peek() == '-') ++place_;
      digits();
    }
    // In the locale of JSON: strtod would read a comma where the program's user writes one.
    std::istringstream in(text_.substr(start, place_ - start));
    in.imbue(std::locale::classic());
    double found = 0.0;
    if (!(in >> found) || !std::isfinite(found)) throw wrong();
    return found;
  }
  void digits() {
    if (!digit()) throw wrong();
    while (digit()) ++place_;
  }

  std::string string() {
    if (peek() != '"') throw wrong();
    std::string out;
    for (++place_; peek() != '"'; ++place_) {
      if (static_cast<unsigned char>(peek()) < 0x20) throw wrong();  // also at the end of the text
      out += peek() == '\\' ? escaped() : std::string(1, peek());
    }
    ++place_;
    return out;
  }
  std::string escaped() {
    ++place_;
    switch (peek()) {
      case '"':
        return "\"";
      case '\\':
        return "\\";
      case '/':
        return "/";
      case 'b':
        return "\b";
      case 'f':
        return "\f";
      case 'n':
        return "\n";
      case 'r':
        return "\r";
      case 't':
        return "\t";
      case 'u':
        break;
      default:
        throw wrong();
    }
    unsigned code = 0;
    for (int i = 0; i < 4; ++i) {
      ++place_;
      if (!std::isxdigit(static_cast<unsigned char>(peek()))) throw wrong();
      const int c = std::tolower(static_cast<unsigned char>(peek()));
      code = code * 16 + static_cast<unsigned>(c <= '9' ? c - '0' : c - 'a' + 10);
    }
    if (code < 0x80) return std::string(1, static_cast<char>(code));
    // As it stands there: names that matter here are ASCII, and others stay different.
    return text_.substr(place_ - 5, 6);
  }

  const std::string& text_;
  const std::string& where_;
  std::size_t place_ = 0;
};

inline Json Json::parse(const std::string& text, const std::string& where) {
  Json out = Parser(text, where).document();
  out.call(where);
  return out;
}

// FIPS 180-4, as sha256sum prints it.
inline std::string sha256(const std::string& bytes) {
  static const auto constants = [] {
    // The first 32 bits of the fractional parts of the cube roots of the first 64 primes, and of the square roots
    // of the first 8.
    std::vector<std::uint32_t> cube, square;
    for (unsigned n = 2; cube.size() < 64; ++n) {
      bool prime = true;
      for (unsigned d = 2; d * d <= n; ++d) prime = prime && n % d != 0;
      if (!prime) continue;
      const auto fraction = [](long double x) {
        return static_cast<std::uint32_t>((x - std::floor(x)) * 4294967296.0L);
      };
      cube.push_back(fraction(std::cbrt(static_cast<long double>(n))));
      if (square.size() < 8) square.push_back(fraction(std::sqrt(static_cast<long double>(n))));
    }
    return std::make_pair(cube, square);
  }();
  const auto turn = [](std::uint32_t x, int by) { return (x >> by) | (x << (32 - by)); };
  std::string padded = bytes + '\x80';
  padded.append((120 - padded.size() % 64) % 64, '\0');
  for (int shift = 56; shift >= 0; shift -= 8)
    padded += static_cast<char>((static_cast<std::uint64_t>(bytes.size()) * 8) >> shift);
  std::vector<std::uint32_t> state = constants.second;
  for (std::size_t block = 0; block < padded.size(); block += 64) {
    std::uint32_t w[64];
    for (int i = 0; i < 64; ++i) {
      if (i < 16) {
        w[i] = 0;
        for (int byte = 0; byte < 4; ++byte)
          w[i] = (w[i] << 8) | static_cast<unsigned char>(padded[block + static_cast<std::size_t>(4 * i + byte)]);
      } else {
        const std::uint32_t a = w[i - 15], b = w[i - 2];
        w[i] = w[i - 16] + (turn(a, 7) ^ turn(a, 18) ^ (a >> 3)) + w[i - 7] + (turn(b, 17) ^ turn(b, 19) ^ (b >> 10));
      }
    }
    std::vector<std::uint32_t> s = state;
    for (int i = 0; i < 64; ++i) {
      const std::uint32_t choice = (s[4] & s[5]) ^ (~s[4] & s[6]);
      const std::uint32_t majority = (s[0] & s[1]) ^ (s[0] & s[2]) ^ (s[1] & s[2]);
      const std::uint32_t one = s[7] + (turn(s[4], 6) ^ turn(s[4], 11) ^ turn(s[4], 25)) + choice +
                                constants.first[static_cast<std::size_t>(i)] + w[i];
      const std::uint32_t two = (turn(s[0], 2) ^ turn(s[0], 13) ^ turn(s[0], 22)) + majority;
      s = {one + two, s[0], s[1], s[2], s[3] + one, s[4], s[5], s[6]};
    }
    for (std::size_t i = 0; i < 8; ++i) state[i] += s[i];
  }
  std::string out;
  for (std::uint32_t word : state)
    for (int shift = 28; shift >= 0; shift -= 4) out += "0123456789abcdef"[(word >> shift) & 15];
  return out;
}

struct Tensor {
  std::vector<std::size_t> shape;
  std::vector<float> values;
};

// Tensors of a safetensors file, all float32 and finite.
inline std::map<std::string, Tensor> safetensors(const std::string& bytes, const std::string& where) {
  std::uint64_t length = 0;
  if (bytes.size() < 8) throw broken(where, "is not a safetensors file: too short");
  std::memcpy(&length, bytes.data(), 8);
  if (length > bytes.size() - 8) throw broken(where, "is not a safetensors file: its header is longer than it is");
  const Json header = Json::parse(bytes.substr(8, static_cast<std::size_t>(length)), where);
  const std::size_t start = 8 + static_cast<std::size_t>(length), size = bytes.size() - start;
  std::map<std::string, Tensor> out;
  for (const std::string& name : header.keys()) {
    if (name == "__metadata__") continue;
    const Json& entry = header.object(name);
    if (entry.text("dtype") != "F32")
      throw broken(where,
                   name + " is " + entry.text("dtype") + ": this reads float32; save the policy after actor.float()");
    Tensor tensor;
    double count = 1;
    for (double n : entry.numbers("shape")) {
      if (!(n >= 1 && n <= 16777216.0 && n == std::floor(n))) throw broken(where, name + " has a broken shape");
      tensor.shape.push_back(static_cast<std::size_t>(n));
      count *= n;
    }
    const auto [from, to] = entry.pair("data_offsets");
    if (!(from >= 0 && from <= to && to <= static_cast<double>(size) && from == std::floor(from) &&
          to - from == 4 * count))
      throw broken(where, name + " has offsets that do not fit its shape and the file");
    tensor.values.resize(static_cast<std::size_t>(count));
    std::memcpy(tensor.values.data(), bytes.data() + start + static_cast<std::size_t>(from), tensor.values.size() * 4);
    for (float value : tensor.values)
      if (!std::isfinite(value)) throw broken(where, name + " is not finite");
    out[name] = std::move(tensor);
  }
  return out;
}

}  // namespace torchrl_morl::files
