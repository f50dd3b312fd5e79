# Install rules. With ROS the layout is catkin's, so that rosrun, roslaunch and nodelet find everything below one prefix;
# without, it is the usual one. Both export the core's libraries: find_package(svort_core), target svort::svort_live.

include(GNUInstallDirs)
include(CMakePackageConfigHelpers)

if(SVORT_WITH_ROS)
  set(svort_lib_dir ${CATKIN_PACKAGE_LIB_DESTINATION})
  set(svort_include_dir ${CATKIN_GLOBAL_INCLUDE_DESTINATION})
  set(svort_share_dir ${CATKIN_PACKAGE_SHARE_DESTINATION})
  set(svort_bin_dir ${CATKIN_PACKAGE_BIN_DESTINATION})
  set(svort_libraries_from_bin ..)
else()
  set(svort_lib_dir ${CMAKE_INSTALL_LIBDIR})
  set(svort_include_dir ${CMAKE_INSTALL_INCLUDEDIR})
  set(svort_share_dir ${CMAKE_INSTALL_DATADIR}/svort_ros)
  set(svort_bin_dir ${CMAKE_INSTALL_BINDIR})
  set(svort_libraries_from_bin ../${CMAKE_INSTALL_LIBDIR})
endif()

# Every library and program of this project finds its libraries relative to itself: the prefix can be moved.
get_property(svort_targets DIRECTORY ${PROJECT_SOURCE_DIR} PROPERTY BUILDSYSTEM_TARGETS)
set(svort_core_libraries svort_geometry svort_acquisition svort_reconstruction svort_network svort_sequence svort_live
    svort_decision svort_registration svort_simulation svort_metrics svort_evaluation svort_training)
set(svort_other_libraries)
set(svort_programs)
foreach(target ${svort_targets})
  get_target_property(type ${target} TYPE)
  if(type STREQUAL "EXECUTABLE")
    set_target_properties(${target} PROPERTIES INSTALL_RPATH "$ORIGIN/${svort_libraries_from_bin}")
    list(APPEND svort_programs ${target})
  elseif(type STREQUAL "SHARED_LIBRARY")
    set_target_properties(${target} PROPERTIES INSTALL_RPATH "$ORIGIN")
    if(NOT target IN_LIST svort_core_libraries)
      list(APPEND svort_other_libraries ${target})
    endif()
  endif()
endforeach()

install(TARGETS ${svort_core_libraries} EXPORT svort_core_targets
  LIBRARY DESTINATION ${svort_lib_dir}
  ARCHIVE DESTINATION ${svort_lib_dir}
  INCLUDES DESTINATION ${svort_include_dir})

# The core's headers; the ROS layer's come with the ROS layer, the messages' by catkin.
install(DIRECTORY include/svort_ros DESTINATION ${svort_include_dir}
  FILES_MATCHING PATTERN "*.h"
  PATTERN io EXCLUDE
  PATTERN ros EXCLUDE)
install(TARGETS ${svort_programs} RUNTIME DESTINATION ${svort_bin_dir})
install(FILES LICENSE DESTINATION ${svort_share_dir})

set(svort_core_config_dir ${svort_lib_dir}/cmake/svort_core)
install(EXPORT svort_core_targets FILE svort_coreTargets.cmake NAMESPACE svort:: DESTINATION ${svort_core_config_dir})
configure_package_config_file(cmake/svort_coreConfig.cmake.in ${PROJECT_BINARY_DIR}/svort_coreConfig.cmake
  INSTALL_DESTINATION ${svort_core_config_dir})
write_basic_package_version_file(${PROJECT_BINARY_DIR}/svort_coreConfigVersion.cmake COMPATIBILITY SameMinorVersion)
install(FILES ${PROJECT_BINARY_DIR}/svort_coreConfig.cmake ${PROJECT_BINARY_DIR}/svort_coreConfigVersion.cmake
  DESTINATION ${svort_core_config_dir})

if(SVORT_WITH_ROS)
  install(TARGETS ${svort_other_libraries}
    LIBRARY DESTINATION ${svort_lib_dir}
    ARCHIVE DESTINATION ${svort_lib_dir})
  install(DIRECTORY include/svort_ros/io include/svort_ros/ros DESTINATION ${svort_include_dir}/svort_ros
    FILES_MATCHING PATTERN "*.h")
  install(FILES nodelet_plugins.xml DESTINATION ${svort_share_dir})
  install(DIRECTORY launch config models DESTINATION ${svort_share_dir})
  install(DIRECTORY data/real DESTINATION ${svort_share_dir}/data)
endif()

if(SVORT_BUILD_TESTS)
  add_subdirectory(test/scripts)
endif()
