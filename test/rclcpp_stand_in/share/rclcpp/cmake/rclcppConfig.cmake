# What find_package(rclcpp) finds in the tests: there is no wheel of rclcpp, and nothing has to spin.
get_filename_component(_include "${CMAKE_CURRENT_LIST_DIR}/../../../include" ABSOLUTE)
add_library(rclcpp::rclcpp INTERFACE IMPORTED)
set_target_properties(rclcpp::rclcpp PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${_include}")
set(rclcpp_TARGETS rclcpp::rclcpp)
