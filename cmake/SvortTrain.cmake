# The trainer. With svort_io it reads NIfTI volumes and draws its curves; in a build of the core alone it reads packs of
# volumes (.pt), and is built where the libraries of its options are found.

if(NOT TARGET svort_io)
  find_package(yaml-cpp QUIET)
  find_package(CLI11 QUIET)
  find_package(nlohmann_json QUIET)
  if(NOT (yaml-cpp_FOUND AND CLI11_FOUND AND nlohmann_json_FOUND))
    message(STATUS "svort_train is not built: it needs yaml-cpp, CLI11 and nlohmann_json")
    return()
  endif()
endif()

add_executable(svort_train src/apps/svort_train.cpp)
svort_target_options(svort_train)
if(TARGET svort_io)
  target_sources(svort_train PRIVATE src/apps/training_files.cpp)
  target_link_libraries(svort_train PRIVATE svort_training svort_io)
else()
  target_sources(svort_train PRIVATE src/apps/training_files_core.cpp)
  target_link_libraries(svort_train PRIVATE svort_training yaml-cpp CLI11::CLI11 nlohmann_json::nlohmann_json)
endif()
