#include <nodelet/nodelet.h>

#include <memory>
#include <pluginlib/class_list_macros.hpp>

#include "svort_ros/ros/svort_server.h"

namespace svort_ros {

/// The server as a nodelet, for a driver in the same process that hands slices over without copying them.
class SvortNodelet : public nodelet::Nodelet {
 private:
  void onInit() override { server_ = std::make_unique<SvortServer>(getNodeHandle(), getPrivateNodeHandle()); }

  std::unique_ptr<SvortServer> server_;
};

}  // namespace svort_ros

PLUGINLIB_EXPORT_CLASS(svort_ros::SvortNodelet, nodelet::Nodelet)
