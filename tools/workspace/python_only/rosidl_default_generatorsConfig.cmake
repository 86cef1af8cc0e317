# Takes the place of rosidl_default_generators where ROS 2 is wheels: only Python nodes use the messages there.
# Code for C++ would take 40 % of the build's time.
find_package(rosidl_core_generators REQUIRED)
list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX "_cpp:")
