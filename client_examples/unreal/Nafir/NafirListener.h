// Hears a scene of a Nafir server: a component of the player's pawn, and one for other players.
#pragma once

#include <atomic>
#include <memory>

#include "Components/SynthComponent.h"
#include "Session.h"

#include "NafirListener.generated.h"

class IWebSocket;

/** Waiting: the connection is lost and is going to be tried again. Refused and Lost are final. */
UENUM(BlueprintType)
enum class ENafirState : uint8
{
	Connecting,
	Live,
	Waiting,
	Refused,
	Lost
};

DECLARE_DYNAMIC_MULTICAST_DELEGATE_TwoParams(FNafirStateChanged, ENafirState, State, const FString&, Problem);
DECLARE_DYNAMIC_MULTICAST_DELEGATE_OneParam(FNafirEmitterEnded, const FString&, Id);

UCLASS(ClassGroup = Audio, meta = (BlueprintSpawnableComponent))
class UNafirListener : public USynthComponent
{
	GENERATED_BODY()

public:
	UPROPERTY(EditAnywhere, BlueprintReadWrite, Category = "Nafir")
	FString Url = TEXT("ws://127.0.0.1:8000/v1/stream");

	UPROPERTY(EditAnywhere, BlueprintReadWrite, Category = "Nafir")
	FString Scene = TEXT("apartment");

	/** An API key or token, if the server asks for one. */
	UPROPERTY(EditAnywhere, BlueprintReadWrite, Category = "Nafir")
	FString Key;

	/** Seconds of sound that are held back against a network that stalls. */
	UPROPERTY(EditAnywhere, BlueprintReadWrite, Category = "Nafir")
	float Buffer = 0.06f;

	/** Seconds for which a server that is gone is tried again. */
	UPROPERTY(EditAnywhere, BlueprintReadWrite, Category = "Nafir")
	float GiveUpAfter = 300.0f;

	/** How many listeners there are going to be, with this one: the server keeps room for them. */
	UPROPERTY(EditAnywhere, BlueprintReadWrite, Category = "Nafir")
	int32 Listeners = 1;

	/** The stream is live, was lost, or is over; the problem says why. */
	UPROPERTY(BlueprintAssignable, Category = "Nafir")
	FNafirStateChanged OnStateChanged;

	/** The clip of an emitter is over, with its reverberation. */
	UPROPERTY(BlueprintAssignable, Category = "Nafir")
	FNafirEmitterEnded OnEmitterEnded;

	/** Adds an emitter that plays a clip of the server, again and again. */
	UFUNCTION(BlueprintCallable, Category = "Nafir")
	void AddClip(const FString& Id, const FString& Clip, FVector Location, float GainDb = 0.0f);

	/** Plays a clip once. Returns the id of its emitter, which is removed when the clip is over. */
	UFUNCTION(BlueprintCallable, Category = "Nafir")
	FString PlayOnce(const FString& Clip, FVector Location, float GainDb = 0.0f);

	UFUNCTION(BlueprintCallable, Category = "Nafir")
	void MoveEmitter(const FString& Id, FVector Location, FRotator Rotation);

	/** Changes a gain over some seconds, linearly in decibels. */
	UFUNCTION(BlueprintCallable, Category = "Nafir")
	void SetGain(const FString& Id, float GainDb, float RampSeconds = 0.0f);

	/** Opens a door of the scene so far, from 0, shut, to 1. */
	UFUNCTION(BlueprintCallable, Category = "Nafir")
	void SetDoor(const FString& Door, float Openness);

	/** Lets a clip fade out; OnEmitterEnded follows. */
	UFUNCTION(BlueprintCallable, Category = "Nafir")
	void StopEmitter(const FString& Id, float FadeSeconds = 0.01f);

	UFUNCTION(BlueprintCallable, Category = "Nafir")
	void RemoveEmitter(const FString& Id);

	/** The stream; null before play begins. */
	nafir::Session* GetSession() const { return Session.get(); }

protected:
	virtual bool Init(int32& SampleRate) override;
	virtual int32 OnGenerateAudio(float* OutAudio, int32 NumSamples) override;
	virtual void BeginPlay() override;
	virtual void EndPlay(const EEndPlayReason::Type EndPlayReason) override;
	virtual void TickComponent(float DeltaTime, ELevelTick TickType, FActorComponentTickFunction* ThisTickFunction) override;

private:
	void Connect();
	void Disconnect(const FString& Why, int32 Code);
	void HandleBinary(const void* Data, SIZE_T Size, bool bIsLastFragment);

	TSharedPtr<IWebSocket> Socket;
	std::unique_ptr<nafir::Session> Session;
	std::atomic<nafir::Session*> Heard{nullptr}; // by the audio thread; lives as long as the component
	TArray<uint8> Message;
	int32 OutputRate = 48000;
};

/**
 * Another listener in the stream of a Nafir Listener, who hears the same emitters from another player's camera: a split screen, or a
 * spectator. A component of that player's pawn, with a sound output of its own.
 */
UCLASS(ClassGroup = Audio, meta = (BlueprintSpawnableComponent))
class UNafirAddedListener : public USynthComponent
{
	GENERATED_BODY()

public:
	/** Whose stream it is. */
	UPROPERTY(EditAnywhere, BlueprintReadWrite, Category = "Nafir")
	UNafirListener* Listener = nullptr;

	/** The player whose camera hears; the Nafir Listener has that of player 0. One component for each player. */
	UPROPERTY(EditAnywhere, BlueprintReadWrite, Category = "Nafir")
	int32 Player = 1;

	/** One of GET /v1/hrtfs; empty for the server's default. */
	UPROPERTY(EditAnywhere, BlueprintReadWrite, Category = "Nafir")
	FString Head;

protected:
	virtual bool Init(int32& SampleRate) override;
	virtual int32 OnGenerateAudio(float* OutAudio, int32 NumSamples) override;
	virtual void BeginPlay() override;
	virtual void EndPlay(const EEndPlayReason::Type EndPlayReason) override;
	virtual void TickComponent(float DeltaTime, ELevelTick TickType, FActorComponentTickFunction* ThisTickFunction) override;

private:
	std::shared_ptr<nafir::Ears> Ears;
	std::atomic<nafir::Ears*> Heard{nullptr}; // by the audio thread; lives as long as the component
};
