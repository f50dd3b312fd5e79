#include "svort_ros/network/checkpoint.h"

#include <torch/serialize.h>

#include <charconv>
#include <fstream>
#include <iterator>
#include <sstream>
#include <stdexcept>
#include <utility>
#include <vector>

#include "sha256.h"

namespace svort {
namespace {

constexpr const char* kFormat = "svort_ros checkpoint";
constexpr std::int64_t kVersion = 1;

using Dictionary = c10::impl::GenericDict;

[[noreturn]] void fail(const std::filesystem::path& file, const std::string& what) {
  throw std::runtime_error(file.string() + ": " + what);
}

std::string shape_of(const torch::Tensor& tensor) {
  std::string text;
  for (const std::int64_t size : tensor.sizes()) text += (text.empty() ? "" : "x") + std::to_string(size);
  return text;
}

std::map<std::string, torch::Tensor> state_of(const torch::nn::Module& module) {
  std::map<std::string, torch::Tensor> state;
  for (const auto& entry : module.named_parameters()) state.emplace(entry.key(), entry.value().detach());
  for (const auto& entry : module.named_buffers()) state.emplace(entry.key(), entry.value().detach());
  return state;
}

Dictionary dictionary() { return Dictionary(c10::StringType::get(), c10::AnyType::get()); }

c10::IValue to_ivalue(const OptionValue& value) {
  return std::visit([](const auto& held) { return c10::IValue(held); }, value);
}

OptionValue to_option(const c10::IValue& value, const std::string& key, const std::filesystem::path& file) {
  if (value.isBool()) return value.toBool();
  if (value.isInt()) return value.toInt();
  if (value.isDouble()) return value.toDouble();
  if (value.isString()) return value.toStringRef();
  fail(file, "option '" + key + "' has a value of the wrong type");
}

/// A dictionary with text as keys; every key is taken once.
class Reader {
 public:
  Reader(const c10::IValue& value, const std::filesystem::path& file, const std::string& what) : file_(file) {
    if (!value.isGenericDict()) fail(file, what + " is not a dictionary");
    for (const auto& entry : value.toGenericDict()) {
      if (!entry.key().isString()) fail(file, "a key of " + what + " is not text");
      values_.emplace(entry.key().toStringRef(), entry.value());
    }
  }
  c10::IValue take(const std::string& key) {
    const auto entry = values_.find(key);
    if (entry == values_.end()) fail(file_, "not a checkpoint of svort_ros: the key '" + key + "' is missing");
    c10::IValue value = entry->second;
    values_.erase(entry);
    return value;
  }
  std::string take_text(const std::string& key) {
    const c10::IValue value = take(key);
    if (!value.isString()) fail(file_, "the value of '" + key + "' is not text");
    return value.toStringRef();
  }
  const std::map<std::string, c10::IValue>& rest() const { return values_; }

 private:
  const std::filesystem::path& file_;
  std::map<std::string, c10::IValue> values_;
};

/// "a, b, c and 7 more"
std::string some_of(const std::vector<std::string>& names) {
  constexpr std::size_t kShown = 3;
  std::string text;
  for (std::size_t i = 0; i < names.size() && i < kShown; ++i) text += (i > 0 ? ", " : "") + names[i];
  if (names.size() > kShown) text += " and " + std::to_string(names.size() - kShown) + " more";
  return text;
}

c10::IValue load_pickle(const std::filesystem::path& file) {
  std::ifstream stream(file, std::ios::binary);
  if (!stream || std::filesystem::is_directory(file)) fail(file, "cannot be read");
  const std::vector<char> bytes((std::istreambuf_iterator<char>(stream)), std::istreambuf_iterator<char>());
  // LibTorch asserts on some broken archives with other types than c10::Error; all of them are std::exception.
  try {
    return torch::pickle_load(bytes);
  } catch (const std::exception&) {
    fail(file, "is truncated, or not a checkpoint of svort_ros (scripts/convert_checkpoint.py converts public ones)");
  }
}

}  // namespace

std::string parameter_sha256(const std::map<std::string, torch::Tensor>& parameters) {
  Sha256 hash;
  for (const auto& [name, tensor] : parameters) {
    const torch::Tensor values = tensor.detach().to(torch::kCPU).contiguous();
    const char* type = values.scalar_type() == torch::kFloat16   ? "float16"
                       : values.scalar_type() == torch::kFloat32 ? "float32"
                                                                 : nullptr;
    if (type == nullptr) throw std::invalid_argument("parameter " + name + " is neither float32 nor float16");
    const std::string kind = std::string(type) + " " + shape_of(values);
    hash.add(name.c_str(), name.size() + 1);
    hash.add(kind.c_str(), kind.size() + 1);
    hash.add(values.data_ptr(), values.nbytes());
  }
  return hash.hexadecimal();
}

void save_network(const std::filesystem::path& file, const NetworkInstance& network, const Provenance& provenance,
                  WeightPrecision precision) {
  const auto type = precision == WeightPrecision::half ? torch::kFloat16 : torch::kFloat32;
  std::map<std::string, torch::Tensor> state;
  Dictionary parameters = dictionary(), options = dictionary(), notes = dictionary(), content = dictionary();
  for (const auto& [name, tensor] : state_of(*network.module)) {
    // Copies: a view would take its whole storage into the file.
    const torch::Tensor values = tensor.to(torch::kCPU).to(type, /*non_blocking=*/false, /*copy=*/true).contiguous();
    state.emplace(name, values);
    parameters.insert(name, values);
  }
  for (const auto& [key, value] : network.options) options.insert(key, to_ivalue(value));
  for (const auto& [key, value] : provenance) notes.insert(key, value);
  content.insert("format", kFormat);
  content.insert("version", kVersion);
  content.insert("network", network.name);
  content.insert("options", options);
  content.insert("parameters", parameters);
  content.insert("provenance", notes);
  content.insert("sha256", parameter_sha256(state));

  const std::vector<char> bytes = torch::pickle_save(content);
  std::filesystem::path unfinished = file;
  unfinished += ".part";
  std::ofstream stream(unfinished, std::ios::binary | std::ios::trunc);
  stream.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
  stream.close();
  if (!stream) fail(file, "cannot be written");
  std::error_code error;
  std::filesystem::rename(unfinished, file, error);
  if (error) fail(file, "cannot be written: " + error.message());
}

Checkpoint read_checkpoint(const std::filesystem::path& file) {
  Reader content(load_pickle(file), file, "the file");
  Checkpoint checkpoint;
  const std::string format = content.take_text("format");
  if (format != kFormat) fail(file, "its format is '" + format + "', expected '" + kFormat + "'");
  const c10::IValue version = content.take("version");
  if (!version.isInt() || version.toInt() != kVersion) {
    fail(file, "is of format version " + (version.isInt() ? std::to_string(version.toInt()) : "?") +
                   "; this program reads version " + std::to_string(kVersion));
  }
  checkpoint.network = content.take_text("network");
  checkpoint.sha256 = content.take_text("sha256");
  const Reader options(content.take("options"), file, "'options'");
  for (const auto& [key, value] : options.rest()) checkpoint.options.emplace(key, to_option(value, key, file));
  const Reader provenance(content.take("provenance"), file, "'provenance'");
  for (const auto& [key, value] : provenance.rest()) {
    if (!value.isString()) fail(file, "provenance '" + key + "' is not text");
    checkpoint.provenance.emplace(key, value.toStringRef());
  }
  const Reader parameters(content.take("parameters"), file, "'parameters'");
  for (const auto& [name, value] : parameters.rest()) {
    if (!value.isTensor()) fail(file, "parameter " + name + " is not a tensor");
    const auto type = value.toTensor().scalar_type();
    if (type != torch::kFloat32 && type != torch::kFloat16)
      fail(file, "parameter " + name + " is neither float32 nor float16");
    checkpoint.parameters.emplace(name, value.toTensor());
  }
  if (!content.rest().empty()) fail(file, "unknown key '" + content.rest().begin()->first + "'");
  const std::string hash = parameter_sha256(checkpoint.parameters);
  if (hash != checkpoint.sha256) {
    fail(file, "is damaged: the parameters' SHA-256 is " + hash + ", the file says " + checkpoint.sha256);
  }
  return checkpoint;
}

NetworkInstance network_from_checkpoint(const Checkpoint& checkpoint, const std::filesystem::path& file) {
  const torch::NoGradGuard no_grad;
  NetworkInstance network;
  try {
    network = make_network(checkpoint.network, checkpoint.options);
  } catch (const std::invalid_argument& error) {
    fail(file, error.what());
  }
  auto state = state_of(*network.module);
  std::vector<std::string> missing, extra, misshapen, broken;
  for (const auto& [name, target] : state) {
    const auto source = checkpoint.parameters.find(name);
    if (source == checkpoint.parameters.end()) {
      missing.push_back(name);
    } else if (source->second.sizes() != target.sizes()) {
      misshapen.push_back(name + " (" + shape_of(source->second) + ", expected " + shape_of(target) + ")");
    } else {
      const torch::Tensor values = source->second.to(target.scalar_type());
      if (!torch::isfinite(values).all().item<bool>()) broken.push_back(name);
      target.copy_(values);
    }
  }
  for (const auto& entry : checkpoint.parameters) {
    if (state.count(entry.first) == 0) extra.push_back(entry.first);
  }
  const std::string start = "does not fit network " + checkpoint.network + ": ";
  if (!missing.empty()) fail(file, start + "missing " + some_of(missing));
  if (!extra.empty()) fail(file, start + "unknown " + some_of(extra));
  if (!misshapen.empty()) fail(file, start + "other shapes of " + some_of(misshapen));
  if (!broken.empty()) fail(file, "NaN or infinity in " + some_of(broken));
  return network;
}

NetworkInstance load_network(const std::filesystem::path& file, Checkpoint* checkpoint) {
  Checkpoint content = read_checkpoint(file);
  NetworkInstance network = network_from_checkpoint(content, file);
  content.parameters.clear();
  if (checkpoint != nullptr) *checkpoint = std::move(content);
  return network;
}

bool is_untrained(const Provenance& provenance) { return provenance.count("untrained") > 0; }

std::optional<std::int64_t> scans_seen(const Provenance& provenance, const std::filesystem::path& file,
                                       const char* key) {
  const auto entry = provenance.find(key);
  if (entry == provenance.end()) return std::nullopt;
  const std::string& text = entry->second;
  std::int64_t scans = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), scans);
  if (error != std::errc() || end != text.data() + text.size() || scans < 0)
    fail(file, std::string("its provenance gives '") + text + "' under '" + key + "', which is no number of scans");
  return scans;
}

}  // namespace svort
