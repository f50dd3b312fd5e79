# Messages, file formats, ROS layer and programs; everything that needs more than LibTorch and Eigen.

find_package(catkin REQUIRED COMPONENTS
  diagnostic_updater dynamic_reconfigure geometry_msgs message_generation nav_msgs nodelet pluginlib rosbag roscpp
  rosgraph_msgs sensor_msgs std_msgs std_srvs tf2 tf2_ros visualization_msgs)
find_package(OpenCV REQUIRED COMPONENTS core imgproc imgcodecs)
find_package(VTK REQUIRED COMPONENTS CommonCore CommonDataModel FiltersCore)
# Debian 12 ships a NIFTI package file whose paths do not exist, so the library is looked up by name.
find_path(NIFTI_INCLUDE_DIR nifti2_io.h PATH_SUFFIXES nifti REQUIRED)
find_library(NIFTI_LIBRARY nifti2 REQUIRED)
find_library(ZNZ_LIBRARY znz REQUIRED)
find_package(yaml-cpp REQUIRED)
find_package(CLI11 REQUIRED)
find_package(nlohmann_json REQUIRED)

add_message_files(FILES Slice.msg SliceStatus.msg SlicePose.msg SequenceEstimate.msg Volume.msg
  HeadMotion.msg SliceQuality.msg SequenceQuality.msg Coverage.msg ReacquisitionRequest.msg ReacquisitionPlan.msg)
add_service_files(FILES Veto.srv)
generate_messages(DEPENDENCIES geometry_msgs sensor_msgs std_msgs)

catkin_package(
  INCLUDE_DIRS include
  LIBRARIES svort_geometry svort_acquisition svort_reconstruction svort_network svort_sequence
            svort_registration svort_live svort_decision svort_simulation svort_metrics svort_evaluation svort_io
            svort_ros_layer
            svort_nodelet
  CATKIN_DEPENDS diagnostic_updater dynamic_reconfigure geometry_msgs message_runtime nav_msgs nodelet pluginlib rosbag roscpp rosgraph_msgs
                 sensor_msgs std_msgs std_srvs tf2 tf2_ros visualization_msgs)

svort_library(svort_io MODULE io
  LINK svort_decision svort_evaluation ${NIFTI_LIBRARY} ${ZNZ_LIBRARY} yaml-cpp CLI11::CLI11 nlohmann_json::nlohmann_json
       opencv_core opencv_imgproc opencv_imgcodecs)
target_include_directories(svort_io SYSTEM PRIVATE ${NIFTI_INCLUDE_DIR})
target_compile_definitions(svort_io PRIVATE SVORT_VERSION="${PROJECT_VERSION}")

svort_library(svort_ros_layer MODULE ros
  LINK svort_live svort_io ${catkin_LIBRARIES} VTK::CommonCore VTK::CommonDataModel VTK::FiltersCore)
target_include_directories(svort_ros_layer SYSTEM PUBLIC ${catkin_INCLUDE_DIRS} ${CATKIN_DEVEL_PREFIX}/include)
add_dependencies(svort_ros_layer ${PROJECT_NAME}_generate_messages_cpp)
list(APPEND SVORT_LIBRARIES svort_io svort_ros_layer)

# Programs and the nodelet's library, where rosrun, roslaunch and pluginlib look for them.
foreach(program svort_node stack_player_node svort_replay nifti_to_bag svort_simulate svort_evaluate svort_accuracy
        svort_calibrate)
  add_executable(${program} src/apps/${program}.cpp)
  if(program MATCHES "svort_(evaluate|accuracy|calibrate)")
    target_link_libraries(${program} PRIVATE svort_io)
  else()
    target_link_libraries(${program} PRIVATE svort_ros_layer)
  endif()
  svort_target_options(${program})
  set_target_properties(${program} PROPERTIES
    RUNTIME_OUTPUT_DIRECTORY ${CATKIN_DEVEL_PREFIX}/${CATKIN_PACKAGE_BIN_DESTINATION})
endforeach()

add_library(svort_nodelet SHARED src/apps/svort_nodelet.cpp)
target_link_libraries(svort_nodelet PUBLIC svort_ros_layer)
svort_target_options(svort_nodelet)
set_target_properties(svort_nodelet PROPERTIES
  LIBRARY_OUTPUT_DIRECTORY ${CATKIN_DEVEL_PREFIX}/${CATKIN_PACKAGE_LIB_DESTINATION})
list(APPEND SVORT_LIBRARIES svort_nodelet)
