#include <ros/ros.h>

#include <cstdio>

#include "svort_ros/ros/svort_server.h"

int main(int argc, char** argv) {
  setvbuf(stdout, nullptr, _IOLBF, 0);  // a progress line must be seen at once in a pipe, too
  ros::init(argc, argv, "svort");
  try {
    const svort_ros::SvortServer server(ros::NodeHandle(), ros::NodeHandle("~"));
    ros::spin();
  } catch (const std::exception& error) {
    ROS_FATAL("%s", error.what());
    return 2;
  }
  return 0;
}
