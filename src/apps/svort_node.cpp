#include <ros/ros.h>

#include "svort_ros/ros/svort_server.h"

int main(int argc, char** argv) {
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
