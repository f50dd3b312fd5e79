#pragma once

#include <filesystem>
#include <opencv2/imgcodecs.hpp>
#include <opencv2/imgproc.hpp>
#include <stdexcept>
#include <string>
#include <vector>

#include "svort_ros/io/atomic_file.h"

namespace svort {

// What all pictures share.

inline const cv::Scalar kWhite(255, 255, 255);
inline const cv::Scalar kInk(40, 40, 40);
inline const cv::Scalar kGrid(225, 225, 225);
// Blue, orange and red that stay apart for colour-blind readers (BGR).
inline const cv::Scalar kBlue(178, 114, 0);
inline const cv::Scalar kOrange(0, 159, 230);
inline const cv::Scalar kRed(0, 60, 200);

enum class Align { left, centre, right };

inline int text_width(const std::string& text, double scale, int weight = 1) {
  int baseline = 0;
  return cv::getTextSize(text, cv::FONT_HERSHEY_SIMPLEX, scale, weight, &baseline).width;
}

/// Text with its baseline at `at`.
inline void put_text(cv::Mat& image, const std::string& text, cv::Point at, double scale, const cv::Scalar& colour,
                     Align align = Align::left, int weight = 1) {
  if (align == Align::centre) at.x -= text_width(text, scale, weight) / 2;
  if (align == Align::right) at.x -= text_width(text, scale, weight);
  cv::putText(image, text, at, cv::FONT_HERSHEY_SIMPLEX, scale, colour, weight, cv::LINE_AA);
}

/// OpenCV's fonts hold ASCII only; other bytes would each show as "?".
inline std::string ascii(std::string text, std::size_t longest) {
  for (char& c : text)
    if (c < ' ' || c > '~') c = '?';
  return text.size() <= longest ? text : text.substr(0, longest - 3) + "...";
}

inline std::string encode_png(const cv::Mat& image) {
  std::vector<unsigned char> png;
  if (!cv::imencode(".png", image, png)) throw std::runtime_error("cannot encode the picture");
  return {png.begin(), png.end()};
}

inline void write_png(const std::filesystem::path& path, const cv::Mat& image) { write_file(path, encode_png(image)); }

}  // namespace svort
