// Conditions for BehaviorTree.CPP 4, which Nav2 uses: SceneComplete and ObjectBelongs.
//
//     scene::Options service{"http://127.0.0.1:8000", scene::Seconds(0.5)};
//     factory.registerNodeType<SceneComplete>("SceneComplete", service);
//     factory.registerNodeType<ObjectBelongs>("ObjectBelongs", service);
//
//     <SceneComplete scene="{scene}" because="{why}"/>
//     <ObjectBelongs scene="{scene}" object="cup_1"/>
//
// `scene` is a request about one room as JSON text (docs/robots.md). C++ has no `Home`, so a moving
// robot makes it from the topic ~/things of the ROS 2 node: single frames have wrong labels. The
// first tick of a condition starts a question in a separate thread. The condition is RUNNING until
// the answer arrives, so a tick never waits. A condition fails if the scene has no objects, or if no
// answer arrives within the client's timeout. `because` gives the reason.
#pragma once

#include <behaviortree_cpp/action_node.h>

#include <algorithm>
#include <condition_variable>
#include <mutex>
#include <optional>
#include <set>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "scene_client.hpp"

// A BT::ConditionNode must not return RUNNING, so the base class is an action node.
class SceneCondition : public BT::StatefulActionNode {
 public:
  using Question = scene::json (scene::Client::*)(const scene::json&, std::optional<scene::Seconds>);

  SceneCondition(const std::string& name, const BT::NodeConfig& config,
                 const scene::Options& service, Question question)
      : StatefulActionNode(name, config),
        client_(service),
        question_(question),
        thread_([this] { answer_each(); }) {}

  // Waits for the question in progress, which ends within the client's timeout.
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

  // The new number makes the thread discard the answer of the question in progress.
  void onHalted() override {
    std::lock_guard<std::mutex> lock(mutex_);
    ++asked_;
    waiting_.reset();
  }

 protected:
  static BT::PortsList ports(BT::PortsList own) {
    own.insert(BT::InputPort<std::string>("scene", "the request as JSON text"));
    own.insert(BT::OutputPort<std::string>("because", "the reason for the result"));
    return own;
  }

  // Whether the condition holds, and the reason.
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
      if (asked != asked_) continue;  // the condition was halted in the meantime
      answer_ = std::move(answer);
      error_ = std::move(error);
      emitWakeUpSignal();  // end the tree's sleep early
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
  std::thread thread_;  // declared last: it uses the other members
};

// SUCCESS if every unlisted object has `log_odds` below the port `log_odds`. The default 0 is a
// probability of 0.5.
class SceneComplete : public SceneCondition {
 public:
  SceneComplete(const std::string& name, const BT::NodeConfig& config,
                const scene::Options& service)
      : SceneCondition(name, config, service, &scene::Client::missing) {}

  static BT::PortsList providedPorts() {
    return ports({BT::InputPort<double>("log_odds", 0.0, "smallest value of a missing object")});
  }

 protected:
  std::pair<bool, std::string> judge(const scene::json& answer) override {
    double least = 0.0;
    getInput("log_odds", least);
    std::string missing;
    for (const auto& thing : answer.at("missing"))
      if (thing.at("log_odds").get<double>() >= least)
        missing += (missing.empty() ? "" : ", ") + word_of(thing);
    if (missing.empty()) return {true, "nothing is missing"};
    return {false, "missing: " + missing};
  }

 private:
  // The word of the request for a class: `listed_as`, or else `label`.
  static std::string word_of(const scene::json& entry) {
    return entry.value("listed_as", entry.at("label").get<std::string>());
  }
};

// SUCCESS if an object fits the scene and its place; FAILURE if it is an outlier, was moved to a
// wrong place, or is not in the scene. The port `object` is an id, a label, a class or a
// broader class. Except with an id, every such object must fit. The service judges places only of
// objects with positions or stated relations.
class ObjectBelongs : public SceneCondition {
 public:
  ObjectBelongs(const std::string& name, const BT::NodeConfig& config,
                const scene::Options& service)
      : SceneCondition(name, config, service, &scene::Client::outliers) {}

  static BT::PortsList providedPorts() {
    return ports({BT::InputPort<std::string>("object", "id, label, class or broader class")});
  }

 protected:
  std::pair<bool, std::string> judge(const scene::json& answer) override {
    std::string named;
    if (!getInput("object", named)) return {false, "no object was named"};
    for (const bool by_id : {true, false}) {
      std::set<std::string> seen;
      for (const auto& thing : answer.at("outliers")) {
        if (by_id ? thing.at("object") != named : !is_a(thing, named)) continue;
        const auto id = thing.at("object").get<std::string>();
        if (thing.at("is_outlier").get<bool>()) return {false, id + " is an outlier"};
        seen.insert(id);
      }
      for (const auto& place : answer.at("misplaced")) {
        const auto moved = place.find("moved");
        if (moved == place.end() || !place.value("is_misplaced", false)) continue;
        if (moved->is_string() && seen.count(moved->get<std::string>()))
          return {false, moved->get<std::string>() + " is in the wrong place: " + words(place)};
      }
      if (!seen.empty()) return {true, *seen.rbegin() + " belongs"};
    }
    return {false, "no " + named + " was seen"};
  }

 private:
  // Whether the object has the word as its label, its class or a broader class: a floor lamp is a
  // lamp.
  static bool is_a(const scene::json& thing, const std::string& word) {
    const auto broader = thing.value("broader", std::vector<std::string>{});
    return thing.at("label") == word || thing.value("listed_as", "") == word ||
           std::find(broader.begin(), broader.end(), word) != broader.end();
  }

  static std::string words(const scene::json& relation) {
    return relation.at("subject").get<std::string>() + " " +
           relation.at("relation").get<std::string>() + " " +
           relation.at("object").get<std::string>();
  }
};
