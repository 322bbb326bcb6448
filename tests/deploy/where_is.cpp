// Reads an answer as JSON, and prints the generated response of the service WhereIs as YAML.
#include <iostream>
#include <nlohmann/json.hpp>

#include "scene_reasoning_msgs/srv/where_is.hpp"

using nlohmann::json;
namespace msg = scene_reasoning_msgs::msg;

template <typename Vector>
Vector vector_of(const json& values) {
  Vector vector;
  vector.x = values.at("x");
  vector.y = values.at("y");
  vector.z = values.at("z");
  return vector;
}

msg::Place place_of(const json& values) {
  msg::Place place;
  place.room = values.at("room");
  place.relation = values.at("relation");
  place.object = values.at("object");
  place.probability = values.at("probability");
  place.is_listed = values.at("is_listed");
  place.position = vector_of<geometry_msgs::msg::Point>(values.at("position"));
  place.position_std = vector_of<geometry_msgs::msg::Vector3>(values.at("position_std"));
  return place;
}

int main() {
  const json answer = json::parse(std::cin);
  scene_reasoning_msgs::srv::WhereIs::Response response;
  response.success = answer.at("success");
  response.message = answer.at("message");
  response.header.stamp.sec = answer.at("header").at("stamp").at("sec");
  response.header.stamp.nanosec = answer.at("header").at("stamp").at("nanosec");
  response.header.frame_id = answer.at("header").at("frame_id");
  for (const auto& values : answer.at("places")) response.places.push_back(place_of(values));
  for (const auto& values : answer.at("rooms")) {
    msg::RoomProbability room;
    room.room = values.at("room");
    room.probability = values.at("probability");
    response.rooms.push_back(room);
  }
  response.not_here = answer.at("not_here");
  std::cout << scene_reasoning_msgs::srv::to_yaml(response);
}
