#pragma once

#include <ATen/autocast_mode.h>
#include <torch/version.h>

namespace svort {

/// While it lives and is enabled, convolutions and matrix products of this thread take and give bfloat16.
class BFloat16Layers {
 public:
  BFloat16Layers(bool enabled, c10::DeviceType device) : enabled_(enabled), device_(device) {
    if (!enabled_) return;
    at::autocast::increment_nesting();
    set(true);
  }
  ~BFloat16Layers() {
    if (!enabled_) return;
    set(false);
    // The weights that were cast are kept until the outermost scope ends.
    if (at::autocast::decrement_nesting() == 0) at::autocast::clear_cache();
  }
  BFloat16Layers(const BFloat16Layers&) = delete;
  BFloat16Layers& operator=(const BFloat16Layers&) = delete;

 private:
  void set(bool on) const {
#if TORCH_VERSION_MAJOR > 2 || (TORCH_VERSION_MAJOR == 2 && TORCH_VERSION_MINOR >= 4)
    at::autocast::set_autocast_enabled(device_, on);
    if (on) at::autocast::set_autocast_dtype(device_, at::kBFloat16);
#else
    if (device_ == c10::DeviceType::CPU) {
      at::autocast::set_cpu_enabled(on);
      if (on) at::autocast::set_autocast_cpu_dtype(at::kBFloat16);
    } else {
      at::autocast::set_enabled(on);
      if (on) at::autocast::set_autocast_gpu_dtype(at::kBFloat16);
    }
#endif
  }

  bool enabled_;
  c10::DeviceType device_;
};

}  // namespace svort
