// As much of BehaviorTree.CPP 4 as the conditions use: what their test is compiled against where the
// library is not installed. Names and signatures are the library's; ports hold text.
#pragma once

#include <atomic>
#include <map>
#include <sstream>
#include <string>
#include <type_traits>
#include <unordered_map>
#include <utility>

namespace BT {

enum class NodeStatus { IDLE, RUNNING, SUCCESS, FAILURE, SKIPPED };

struct PortInfo {
  std::string default_value;
};
using PortsList = std::unordered_map<std::string, PortInfo>;

template <typename T>
std::pair<std::string, PortInfo> InputPort(const std::string& name, const std::string&) {
  return {name, {}};
}
template <typename T>
std::pair<std::string, PortInfo> InputPort(const std::string& name, const T& value,
                                           const std::string&) {
  return {name, {std::to_string(value)}};
}
template <typename T>
std::pair<std::string, PortInfo> OutputPort(const std::string& name, const std::string&) {
  return {name, {}};
}

struct NodeConfig {
  std::map<std::string, std::string>* blackboard = nullptr;  // one entry for each port
};

// The library's Result: true, or an error.
struct Result {
  bool fine;
  explicit operator bool() const { return fine; }
};

class TreeNode {
 public:
  TreeNode(std::string name, NodeConfig config) : name_(std::move(name)), config_(config) {}
  virtual ~TreeNode() = default;
  TreeNode(const TreeNode&) = delete;
  TreeNode& operator=(const TreeNode&) = delete;

  template <typename T>
  Result getInput(const std::string& key, T& destination) const {
    const auto found = config_.blackboard->find(key);
    if (found == config_.blackboard->end()) return {false};
    if constexpr (std::is_same_v<T, std::string>) {
      destination = found->second;
      return {true};
    } else {
      std::istringstream text(found->second);
      return {static_cast<bool>(text >> destination)};
    }
  }
  template <typename T>
  Result setOutput(const std::string& key, const T& value) {
    (*config_.blackboard)[key] = value;
    return {true};
  }
  void emitWakeUpSignal() { ++woken; }

  std::atomic<int> woken{0};

 private:
  std::string name_;
  NodeConfig config_;
};

class StatefulActionNode : public TreeNode {
 public:
  StatefulActionNode(const std::string& name, const NodeConfig& config) : TreeNode(name, config) {}
  virtual NodeStatus onStart() = 0;
  virtual NodeStatus onRunning() = 0;
  virtual void onHalted() = 0;

  // What the tree does with it.
  NodeStatus executeTick() {
    status_ = status_ == NodeStatus::RUNNING ? onRunning() : onStart();
    return status_;
  }
  void haltNode() {
    if (status_ == NodeStatus::RUNNING) onHalted();
    status_ = NodeStatus::IDLE;
  }

 private:
  NodeStatus status_ = NodeStatus::IDLE;
};

}  // namespace BT
