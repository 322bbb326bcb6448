// Conditions for BehaviorTree.CPP 4 (and so for Nav2): is something missing, does something belong?
//
//     scene::Options service{"http://127.0.0.1:8000", scene::Seconds(0.5)};
//     factory.registerNodeType<SceneComplete>("SceneComplete", service);
//     factory.registerNodeType<ObjectBelongs>("ObjectBelongs", service);
//
//     <SceneComplete scene="{scene}" because="{why}"/>
//     <ObjectBelongs scene="{scene}" object="cup_1"/>
//
// `scene` is a request as JSON text (docs/robots.md). A condition asks when it is first ticked, in a
// thread of its own, and is RUNNING until the answer is there: no tick waits. It fails where nothing
// was seen or no answer came; `because` says why. The client's timeout bounds how long that takes.
#pragma once

#include <behaviortree_cpp/action_node.h>

#include <condition_variable>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>

#include "scene_client.hpp"

// Conditions of BehaviorTree.CPP must not be RUNNING, so these are actions in its sense.
class SceneCondition : public BT::StatefulActionNode {
 public:
  using Question = scene::json (scene::Client::*)(const scene::json&, std::optional<scene::Seconds>);

  SceneCondition(const std::string& name, const BT::NodeConfig& config,
                 const scene::Options& service, Question question)
      : StatefulActionNode(name, config),
        client_(service),
        question_(question),
        thread_([this] { answer_each(); }) {}

  // Waits for a question in flight, which ends within the client's timeout.
  ~SceneCondition() override {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      closing_ = true;
    }
    changed_.notify_one();
    thread_.join();
  }

  BT::NodeStatus onStart() override {
    std::string text;
    if (!getInput("scene", text)) return fail("there is no scene");
    auto request = scene::json::parse(text, nullptr, /*allow_exceptions=*/false);
    if (!request.is_object()) return fail("the scene is no JSON object");
    const auto objects = request.find("objects");
    if (objects == request.end() || objects->empty()) return fail("nothing was seen");
    {
      std::lock_guard<std::mutex> lock(mutex_);
      ++asked_;
      answer_.reset();
      waiting_ = std::move(request);
    }
    changed_.notify_one();
    return BT::NodeStatus::RUNNING;
  }

  BT::NodeStatus onRunning() override {
    std::lock_guard<std::mutex> lock(mutex_);
    if (!answer_) return BT::NodeStatus::RUNNING;
    if (!error_.empty()) return fail(error_);
    try {
      const auto [holds, because] = judge(*answer_);
      setOutput("because", because);
      return holds ? BT::NodeStatus::SUCCESS : BT::NodeStatus::FAILURE;
    } catch (const scene::json::exception& error) {
      return fail(error.what());
    }
  }

  // Nobody reads the answer any more: the next question's takes its place.
  void onHalted() override {
    std::lock_guard<std::mutex> lock(mutex_);
    ++asked_;
    waiting_.reset();
  }

 protected:
  static BT::PortsList ports(BT::PortsList own) {
    own.insert(BT::InputPort<std::string>("scene", "a request, as JSON"));
    own.insert(BT::OutputPort<std::string>("because", "why it holds, or does not"));
    return own;
  }

  // Whether the condition holds, and why.
  virtual std::pair<bool, std::string> judge(const scene::json& answer) = 0;

 private:
  BT::NodeStatus fail(const std::string& why) {
    setOutput("because", why);
    return BT::NodeStatus::FAILURE;
  }

  void answer_each() {
    std::unique_lock<std::mutex> lock(mutex_);
    while (true) {
      changed_.wait(lock, [this] { return closing_ || waiting_; });
      if (closing_) return;
      const auto request = std::move(*waiting_);
      waiting_.reset();
      const auto asked = asked_;
      lock.unlock();
      scene::json answer;
      std::string error;
      try {
        answer = (client_.*question_)(request, std::nullopt);
      } catch (const scene::Error& problem) {
        error = problem.what();
      }
      lock.lock();
      if (asked != asked_) continue;  // halted meanwhile
      answer_ = std::move(answer);
      error_ = std::move(error);
      emitWakeUpSignal();  // the tree need not sleep on
    }
  }

  scene::Client client_;
  Question question_;
  std::mutex mutex_;
  std::condition_variable changed_;
  bool closing_ = false;
  unsigned long asked_ = 0;
  std::optional<scene::json> waiting_;
  std::optional<scene::json> answer_;
  std::string error_;
  std::thread thread_;  // last: it uses the others
};

// SUCCESS as long as nothing is missing that is rather there than not: the log-odds of presence
// against absence from which on a thing counts as missing are 0, which is even, unless told.
class SceneComplete : public SceneCondition {
 public:
  SceneComplete(const std::string& name, const BT::NodeConfig& config,
                const scene::Options& service)
      : SceneCondition(name, config, service, &scene::Client::missing) {}

  static BT::PortsList providedPorts() {
    return ports({BT::InputPort<double>("log_odds", 0.0, "from which on a thing is missing")});
  }

 protected:
  std::pair<bool, std::string> judge(const scene::json& answer) override {
    double least = 0.0;
    getInput("log_odds", least);
    std::string missing;
    for (const auto& thing : answer.at("missing"))
      if (thing.at("log_odds").get<double>() >= least)
        missing += (missing.empty() ? "" : ", ") + thing.at("label").get<std::string>();
    if (missing.empty()) return {true, "nothing is missing"};
    return {false, "missing: " + missing};
  }
};

// SUCCESS if a thing that was seen fits the scene; FAILURE if it is an outlier, or not there. The
// thing is named by its id, or by a label: then every thing of this label has to belong.
class ObjectBelongs : public SceneCondition {
 public:
  ObjectBelongs(const std::string& name, const BT::NodeConfig& config,
                const scene::Options& service)
      : SceneCondition(name, config, service, &scene::Client::outliers) {}

  static BT::PortsList providedPorts() {
    return ports({BT::InputPort<std::string>("object", "an id or a label")});
  }

 protected:
  std::pair<bool, std::string> judge(const scene::json& answer) override {
    std::string named;
    if (!getInput("object", named)) return {false, "no object was named"};
    for (const char* by : {"object", "label"}) {
      std::string seen, outlier;
      for (const auto& thing : answer.at("outliers")) {
        if (thing.at(by) != named) continue;
        seen = thing.at("object").get<std::string>();
        if (outlier.empty() && thing.at("is_outlier").get<bool>()) outlier = seen;
      }
      if (!outlier.empty()) return {false, outlier + " is an outlier"};
      if (!seen.empty()) return {true, seen + " belongs"};
    }
    return {false, "no " + named + " was seen"};
  }
};
