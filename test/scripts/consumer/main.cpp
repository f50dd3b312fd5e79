#include <svort_ros/live/live_pipeline.h>

#include <cstdio>

// One slice through the installed pipeline; prints where the brain frame came to lie.
int main() {
  svort::LivePipeline pipeline{svort::PipelineOptions()};
  svort::Slice slice;
  slice.info.scan_id = "consumer";
  slice.info.slices_in_stack = 1;
  slice.info.T_scanner_slice.translation().z() = 12.;
  slice.info.pixel_spacing = {2., 2.};
  slice.info.thickness = 3.;
  slice.info.columns = slice.info.rows = 32;
  slice.pixels.assign(32 * 32, 100.F);
  slice.mask.assign(32 * 32, 1);
  const svort::Arrival arrival = pipeline.add(slice);
  std::printf("%s, head at z = %.1f mm\n", svort::to_string(arrival.status),
              pipeline.estimate().slices.at(0).T_scanner_brain.translation().z());
  return 0;
}
