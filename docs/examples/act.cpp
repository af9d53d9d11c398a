// A trained team with continuous actions, in plain C++17: `race export DIR --out team.safetensors`.
//
//   g++ -O2 -std=c++17 act.cpp -o act
//   echo "0.1 0.2 0.3 ..." | ./act team.safetensors
//
// Reads what the agents observe, N * O numbers a line (padded to the largest agent, agent by
// agent), and prints the joint action, U numbers a line, in the environment's units.
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <iostream>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

struct Array {
  std::vector<size_t> shape;
  std::vector<float> values;
};

// A safetensors file is the length of a JSON header, the header, and the arrays end to end.
class Weights {
 public:
  explicit Weights(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    if (!file) throw std::runtime_error("cannot read " + path);
    std::stringstream all;
    all << file.rdbuf();
    content_ = all.str();
    uint64_t length = 0;
    std::memcpy(&length, content_.data(), 8);
    header_ = content_.substr(8, length);
    start_ = 8 + length;
  }

  Array operator()(const std::string& name) const {
    const size_t entry = header_.find("\"" + name + "\":{");
    if (entry == std::string::npos) throw std::runtime_error("there is no array " + name);
    Array array;
    array.shape = numbers(entry, "\"shape\":[");
    const std::vector<size_t> place = numbers(entry, "\"data_offsets\":[");
    const char* from = content_.data() + start_ + place[0];
    const bool whole = header_.compare(header_.find("\"dtype\":\"", entry) + 9, 3, "I64") == 0;
    for (size_t at = 0; at < place[1] - place[0]; at += whole ? 8 : 4) {
      int64_t integer = 0;
      float number = 0;
      std::memcpy(whole ? (void*)&integer : (void*)&number, from + at, whole ? 8 : 4);
      array.values.push_back(whole ? float(integer) : number);
    }
    return array;
  }

  bool has(const std::string& name) const {
    return header_.find("\"" + name + "\":{") != std::string::npos;
  }

  bool layer_norm() const { return header_.find("\"layer_norm\":\"1\"") != std::string::npos; }

 private:
  std::vector<size_t> numbers(size_t entry, const std::string& key) const {
    std::vector<size_t> found;
    std::stringstream text(header_.substr(header_.find(key, entry) + key.size()));
    for (size_t value; text >> value;) {
      found.push_back(value);
      if (text.peek() == ',') text.ignore();
    }
    return found;
  }

  std::string content_, header_;
  size_t start_;
};

// One layer of one agent; arrays that all agents share have a leading axis of 1.
std::vector<float> layer(const std::vector<float>& x, const Array& weight, const Array& bias,
                         size_t agent, bool layer_norm) {
  const size_t in = weight.shape[1], out = weight.shape[2];
  const float* w = &weight.values[(weight.shape[0] > 1 ? agent : 0) * in * out];
  const float* b = &bias.values[(bias.shape[0] > 1 ? agent : 0) * out];
  std::vector<float> y(b, b + out);
  for (size_t i = 0; i < in; ++i)
    for (size_t o = 0; o < out; ++o) y[o] += x[i] * w[i * out + o];
  if (layer_norm) {
    float mean = 0, variance = 0;
    for (float value : y) mean += value / out;
    for (float value : y) variance += (value - mean) * (value - mean) / out;
    for (float& value : y) value = (value - mean) / std::sqrt(variance + 1e-5f);
  }
  for (float& value : y) value = std::tanh(value);
  return y;
}

int main(int count, char** words) try {
  if (count != 2) throw std::runtime_error("usage: act team.safetensors < observations");
  const Weights weights(words[1]);
  const bool norm = weights.layer_norm();
  const Array hidden = weights("hidden.weight"), hidden_bias = weights("hidden.bias");
  const Array out = weights("out.weight"), out_bias = weights("out.bias");
  const Array head = weights("head.weight"), head_bias = weights("head.bias");
  const Array joint = weights("joint"), low = weights("low"), high = weights("high");
  const size_t agents = head.shape[0], obs_size = hidden.shape[1];
  const bool scaled = weights.has("obs.mean");
  const Array mean = scaled ? weights("obs.mean") : Array();
  const Array factor = scaled ? weights("obs.factor") : Array();
  for (std::string line; std::getline(std::cin, line);) {
    std::stringstream text(line);
    std::vector<float> all;
    for (size_t agent = 0; agent < agents; ++agent) {
      std::vector<float> obs(obs_size);
      for (float& value : obs)
        if (!(text >> value)) throw std::runtime_error("a line has too few numbers");
      for (size_t entry = 0; scaled && entry < obs_size; ++entry) {
        const size_t at = agent * obs_size + entry;
        const float apart = (obs[entry] - mean.values[at]) * factor.values[at];
        obs[entry] = std::fmin(std::fmax(apart, -10.0f), 10.0f);
      }
      const std::vector<float> first = layer(obs, hidden, hidden_bias, agent, norm);
      const std::vector<float> z = layer(first, out, out_bias, agent, norm);
      const std::vector<float> action = layer(z, head, head_bias, agent, false);
      all.insert(all.end(), action.begin(), action.end());
    }
    for (size_t entry = 0; entry < joint.values.size(); ++entry) {
      const float a = all[size_t(joint.values[entry])];
      const float from = low.values[entry], to = high.values[entry];
      std::printf("%.9g ", from == -to ? a * to : from + (a + 1) / 2 * (to - from));
    }
    std::printf("\n");
  }
  return 0;
} catch (const std::exception& error) {
  std::cerr << "act: " << error.what() << "\n";
  return 1;
}
