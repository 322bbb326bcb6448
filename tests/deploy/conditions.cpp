// Ticks one condition as a tree does: conditions URL KIND TIMEOUT, and its ports as a JSON object on
// a line; `halt: true` in them halts it after the first tick. Prints the status and `because`.
#include <chrono>
#include <iostream>
#include <memory>
#include <thread>

#include "scene_conditions.hpp"

int main(int, char** arguments) {
  const std::string kind = arguments[2];
  scene::Options service{arguments[1], scene::Seconds(std::stod(arguments[3]))};
  service.retries = 0;
  std::map<std::string, std::string> blackboard;
  const auto list = kind == "SceneComplete" ? SceneComplete::providedPorts()
                                            : ObjectBelongs::providedPorts();
  std::unique_ptr<SceneCondition> condition;
  if (kind == "SceneComplete")
    condition = std::make_unique<SceneComplete>("it", BT::NodeConfig{&blackboard}, service);
  else
    condition = std::make_unique<ObjectBelongs>("it", BT::NodeConfig{&blackboard}, service);

  std::string line;
  while (std::getline(std::cin, line)) {
    blackboard.clear();
    for (const auto& [name, port] : list)
      if (!port.default_value.empty()) blackboard[name] = port.default_value;
    bool halt = false;
    const auto ports = scene::json::parse(line);
    for (const auto& [name, value] : ports.items()) {
      if (name == "halt")
        halt = true;
      else
        blackboard[name] = value.get<std::string>();
    }
    auto status = condition->executeTick();
    const bool waited = status == BT::NodeStatus::RUNNING;
    if (halt) {
      condition->haltNode();
      std::cout << scene::json{{"status", "HALTED"}}.dump() << std::endl;
      continue;
    }
    while (status == BT::NodeStatus::RUNNING) {
      std::this_thread::sleep_for(std::chrono::milliseconds(2));
      status = condition->executeTick();
    }
    std::cout << scene::json{{"status", status == BT::NodeStatus::SUCCESS ? "SUCCESS" : "FAILURE"},
                             {"because", blackboard["because"]},
                             {"waited", waited},
                             {"woken", condition->woken.load()}}
                     .dump()
              << std::endl;
  }
}
